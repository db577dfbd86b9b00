"""Map files in a coordinate system of the Earth: UTM coordinates of points, and the top view as GeoTIFF."""

from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from segslam.core.extras import how_to_install
from segslam.core.types import Points, SegslamError
from segslam.output.map.from_above import Window
from segslam.output.map.picture import Picture

if TYPE_CHECKING:
    from segslam.gnss.geodesy import Origin

CORNERS = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])


class Utm:
    """Coordinates in the UTM zone of an origin; heights stay ellipsoidal."""

    def __init__(self, origin: "Origin") -> None:
        from pyproj import Transformer

        from segslam.gnss.geodesy import WGS84_3D, utm_epsg

        self._origin = origin
        self.epsg = utm_epsg(origin.latitude_deg, origin.longitude_deg)
        self._transformer = Transformer.from_crs(WGS84_3D, self.epsg, always_xy=True)

    def __call__(self, enu_m: Points) -> Points:
        """(n, 3) easting, northing, height (m) of points (n, 3) in the local frame of the origin."""
        from segslam.gnss.geodesy import geodetic_from_enu

        latitude, longitude, height_m = geodetic_from_enu(enu_m, self._origin).T
        easting, northing = self._transformer.transform(longitude, latitude)
        return np.column_stack([easting, northing, height_m])


class GeoTiff(Picture):
    """The top view without legend as GeoTIFF in UTM; needs the origin of a georeferenced run."""

    def close(self) -> None:
        """Write the image."""
        import rasterio
        from rasterio.transform import Affine

        origin = self._extent.origin
        assert origin is not None, "checked before the map is made"
        utm = Utm(origin)
        image, window, height_m = self._finished()
        rows, columns = image.shape[:2]
        with rasterio.open(
            self._file,
            "w",
            driver="GTiff",
            height=rows,
            width=columns,
            count=3,
            dtype="uint8",
            crs=f"EPSG:{utm.epsg}",
            transform=Affine(*_affine(utm, window, rows, columns, height_m).ravel()),
            compress="deflate",
            photometric="RGB",
        ) as file:
            file.write(image.transpose(2, 0, 1))


def _affine(utm: Utm, window: Window, rows: int, columns: int, height_m: float) -> Points:
    """(2, 3) map from column and row to UTM: exact to a centimetre within a few kilometres.

    UTM turns and scales the local frame; its curvature is 4 mm over a kilometre, far from the central meridian.
    """
    west, east, south, north = window
    places = np.column_stack(
        [west + CORNERS[:, 0] * (east - west), north - CORNERS[:, 1] * (north - south), np.full(4, height_m)]
    )
    pixels = np.column_stack([CORNERS * [columns, rows], np.ones(4)])
    solution, *_ = np.linalg.lstsq(pixels, utm(places)[:, :2], rcond=None)
    return solution.T


def check_projected(file: Path, origin: "Origin | None") -> None:
    """Raises SegslamError if packages are missing, or if the run was not georeferenced."""
    missing = [name for name in ("pyproj", "rasterio") if find_spec(name) is None]
    if missing:
        raise SegslamError(f"{file}: GeoTIFF needs extra packages: {how_to_install('geo')}; .png does not")
    if origin is None:
        raise SegslamError(f"{file}: the run has no place on the globe; `segslam georeference RUN --gnss FIXES` first")
