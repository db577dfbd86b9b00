"""Map files in a coordinate system of the Earth: UTM coordinates of points, and the top view as GeoTIFF."""

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from segslam.core.types import Points
from segslam.output.map.from_above import Window
from segslam.output.map.picture import Picture

if TYPE_CHECKING:
    from segslam.gnss.geodesy import Origin

CORNERS = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])


def utm(origin: "Origin") -> tuple[int, Callable[[Points], Points]]:
    """EPSG code of the UTM zone of an origin; its local frame (n, 3) to easting, northing, ellipsoidal height (m)."""
    from pyproj import Transformer

    from segslam.gnss.geodesy import WGS84_3D, geodetic_from_enu, utm_epsg

    epsg = utm_epsg(origin.latitude_deg, origin.longitude_deg)
    transformer = Transformer.from_crs(WGS84_3D, epsg, always_xy=True)

    def projected(enu_m: Points) -> Points:
        latitude, longitude, height_m = geodetic_from_enu(enu_m, origin).T
        return np.column_stack([*transformer.transform(longitude, latitude), height_m])

    return epsg, projected


class GeoTiff(Picture):
    """The top view without legend as GeoTIFF in UTM; needs the origin of a georeferenced run."""

    def close(self) -> None:
        """Write the image."""
        import rasterio
        from rasterio.transform import Affine

        origin = self._store.origin
        assert origin is not None, "checked before the map is made"
        epsg, projected = utm(origin)
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
            crs=f"EPSG:{epsg}",
            transform=Affine(*_affine(projected, window, rows, columns, height_m).ravel()),
            compress="deflate",
            photometric="RGB",
        ) as file:
            file.write(image.transpose(2, 0, 1))


def _affine(projected: Callable[[Points], Points], window: Window, rows: int, columns: int, height_m: float) -> Points:
    """(2, 3) map from column and row to UTM: exact to a centimetre within a few kilometres.

    UTM turns and scales the local frame; its curvature is 4 mm over a kilometre, far from the central meridian.
    """
    west, east, south, north = window
    places = np.column_stack(
        [west + CORNERS[:, 0] * (east - west), north - CORNERS[:, 1] * (north - south), np.full(4, height_m)]
    )
    pixels = np.column_stack([CORNERS * [columns, rows], np.ones(4)])
    solution, *_ = np.linalg.lstsq(pixels, projected(places)[:, :2], rcond=None)
    return solution.T
