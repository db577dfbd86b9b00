"""Position fixes of a receiver (GNSS): a finished drive is placed on the globe, and bent where fixes are better."""

from segslam.gnss.fixes import Fixes
from segslam.gnss.geodesy import Origin, enu_from_geodetic, geodetic_from_enu, utm_epsg
from segslam.gnss.georeference import Georeference, Use, georeference
from segslam.gnss.matching import Drive

__all__ = [
    "Drive",
    "Fixes",
    "Georeference",
    "Origin",
    "Use",
    "enu_from_geodetic",
    "geodetic_from_enu",
    "georeference",
    "utm_epsg",
]
