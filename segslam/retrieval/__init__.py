"""Places by their look: which keyframes may show the place of a scan, with no guess of where that is."""

from segslam.retrieval.places import PlaceCandidate, Places
from segslam.retrieval.signature import PlaceSignature, signature_of, signature_of_standing, signatures_around

__all__ = ["PlaceCandidate", "PlaceSignature", "Places", "signature_of", "signature_of_standing", "signatures_around"]
