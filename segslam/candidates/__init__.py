"""Place recognition: keyframes whose surroundings resemble those of a scan, without initial guess."""

from segslam.candidates.places import PlaceCandidate, Places
from segslam.candidates.signature import PlaceSignature, signature_of, signature_of_standing, signatures_around

__all__ = ["PlaceCandidate", "PlaceSignature", "Places", "signature_of", "signature_of_standing", "signatures_around"]
