"""Geodetic, Earth-centred and local coordinates on the WGS84 ellipsoid, and the UTM zone of a place.

    symbol  meaning
    a, e2   semi-major axis (m), squared first eccentricity
    n       radius of curvature in the prime vertical (m)
    ECEF    Earth-centred, Earth-fixed frame
    ENU     local frame: x east, y north, z up, tangent to the ellipsoid at its origin

Source: Groves, "Principles of GNSS, Inertial, and Multisensor Integrated Navigation Systems", 2nd edition, section 2.4;
from ECEF to geodetic coordinates: Bowring, "The accuracy of geodetic latitude and height equations", 1985.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation as ScipyRotation

from segslam.core.types import Points, Rotation

SEMI_MAJOR_M = 6_378_137.0
FLATTENING = 1.0 / 298.257223563
ECCENTRICITY2 = FLATTENING * (2.0 - FLATTENING)
SEMI_MINOR_M = SEMI_MAJOR_M * (1.0 - FLATTENING)
WGS84_3D = 4979
"""EPSG code of latitude, longitude and ellipsoidal height."""
BOWRING_STEPS = 3
"""Chosen: one step is exact to 1e-9 degrees on the ground, three also at the heights of satellites."""

Geodetic = Float[np.ndarray, "_ 3"]
"""Latitude and longitude (degrees), height above the ellipsoid (m), a row for each place."""


class Origin(NamedTuple):
    """Origin of a local frame: latitude and longitude (degrees), height above the ellipsoid (m)."""

    latitude_deg: float
    longitude_deg: float
    height_m: float


def ecef_from_geodetic(places: Geodetic) -> Points:
    """(n, 3) ECEF positions (m) of geodetic places (n, 3)."""
    latitude, longitude = np.radians(places[:, 0]), np.radians(places[:, 1])
    sine, cosine, height_m = np.sin(latitude), np.cos(latitude), places[:, 2]
    n = SEMI_MAJOR_M / np.sqrt(1.0 - ECCENTRICITY2 * sine**2)  # Groves, eq. (2.106)
    level = (n + height_m) * cosine
    return np.column_stack(  # eq. (2.112)
        [level * np.cos(longitude), level * np.sin(longitude), ((1.0 - ECCENTRICITY2) * n + height_m) * sine]
    )


def geodetic_from_ecef(ecef_m: Points) -> Geodetic:
    """(n, 3) geodetic places of ECEF positions (n, 3); longitudes in (-180, 180]. The inverse of `ecef_from_geodetic`.

    Not for positions within 50 km of the centre of the Earth.
    """
    x, y, z = ecef_m.T
    level = np.hypot(x, y)
    second2 = ECCENTRICITY2 / (1.0 - ECCENTRICITY2)
    parametric = np.arctan2(SEMI_MAJOR_M * z, SEMI_MINOR_M * level)
    for _ in range(BOWRING_STEPS):
        latitude = np.arctan2(
            z + second2 * SEMI_MINOR_M * np.sin(parametric) ** 3,
            level - ECCENTRICITY2 * SEMI_MAJOR_M * np.cos(parametric) ** 3,
        )
        parametric = np.arctan2((1.0 - FLATTENING) * np.sin(latitude), np.cos(latitude))
    sine, cosine = np.sin(latitude), np.cos(latitude)
    root = np.sqrt(1.0 - ECCENTRICITY2 * sine**2)
    height_m = level * cosine + z * sine - SEMI_MAJOR_M * root  # exact also at the poles
    return np.column_stack([np.degrees(latitude), np.degrees(np.arctan2(y, x)), height_m])


def enu_from_geodetic(places: Geodetic, origin: Origin) -> Points:
    """(n, 3) east, north, up (m) of geodetic places (n, 3) in the local frame of `origin`, exact at any distance."""
    return (ecef_from_geodetic(places) - ecef_from_geodetic(np.array([origin]))) @ rotation_ecef_enu(origin)


def geodetic_from_enu(enu_m: Points, origin: Origin) -> Geodetic:
    """(n, 3) geodetic places of positions (n, 3) east, north, up (m) in the local frame of `origin`."""
    return geodetic_from_ecef(enu_m @ rotation_ecef_enu(origin).T + ecef_from_geodetic(np.array([origin])))


def rotation_ecef_enu(origin: Origin) -> Rotation:
    """(3, 3) rotation from the local frame to ECEF: its columns are east, north and up (Groves, eq. (2.150))."""
    angles_deg = [90.0 + origin.longitude_deg, 90.0 - origin.latitude_deg]
    return ScipyRotation.from_euler("ZX", angles_deg, degrees=True).as_matrix()


def utm_epsg(latitude_deg: float, longitude_deg: float) -> int:
    """EPSG code of the UTM zone (WGS84) of a place, with the exceptions of Norway and Svalbard.

    Beyond UTM's latitudes, 80 degrees south to 84 north, it is that of the polar stereographic projection (UPS).
    """
    if not -80.0 <= latitude_deg <= 84.0:
        return 32661 if latitude_deg > 0.0 else 32761
    longitude = (longitude_deg + 180.0) % 360.0 - 180.0
    zone = min(int((longitude + 180.0) // 6.0), 59) + 1
    if 56.0 <= latitude_deg < 64.0 and 3.0 <= longitude < 12.0:
        zone = 32
    elif latitude_deg >= 72.0 and 0.0 <= longitude < 42.0:
        zone = 31 + 2 * int((longitude + 3.0) // 12.0)
    return (32600 if latitude_deg >= 0.0 else 32700) + zone


def utm(origin: Origin) -> tuple[int, Callable[[Points], Points]]:
    """EPSG code of the UTM zone of an origin; its local frame (n, 3) to easting, northing, ellipsoidal height (m)."""
    from pyproj import Transformer

    epsg = utm_epsg(origin.latitude_deg, origin.longitude_deg)
    transformer = Transformer.from_crs(WGS84_3D, epsg, always_xy=True)

    def projected(enu_m: Points) -> Points:
        latitude, longitude, height_m = geodetic_from_enu(enu_m, origin).T
        return np.column_stack([*transformer.transform(longitude, latitude), height_m])

    return epsg, projected
