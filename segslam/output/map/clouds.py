"""Point cloud files written piece by piece: PLY, PCD, LAS and LAZ."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from segslam.core.types import Label, Points
from segslam.output.map.tiles import Part

if TYPE_CHECKING:
    from segslam.output.map.write import MapStore

HEADER_BYTES = 512
"""Bytes reserved for the header, which is written last because it contains the number of points."""
ASPRS_OF_LABEL = {
    Label.ROAD: 11,
    Label.PARKING: 11,
    Label.SIDEWALK: 2,
    Label.OTHER_GROUND: 2,
    Label.TERRAIN: 2,
    Label.BUILDING: 6,
    Label.VEGETATION: 5,
    Label.TRUNK: 5,
}
"""Classes of the LAS 1.4 specification, table 17: 2 ground, 5 high vegetation, 6 building, 11 road; else 1."""


class BinaryCloud:
    """A header, then a row of a fixed layout for each point; the header is written last."""

    row: ClassVar[tuple[Any, ...]]
    color_order: ClassVar[tuple[int, int, int]]
    """Bytes of red, green and blue in the field `color`."""
    filler: ClassVar[str]
    last_line: ClassVar[str]

    def __init__(self, file: Path, store: "MapStore") -> None:
        self._stream = file.open("wb")
        self._stream.write(bytes(HEADER_BYTES))
        self._intensity = ["intensity"] if store.has_intensities else []
        self._row = np.dtype([*self.row, *((name, "<f4") for name in self._intensity)])
        self._num_points = 0

    def add(self, part: Part) -> None:
        """Append the points of a part."""
        rows = np.zeros(len(part.points), self._row)
        rows["xyz"], rows["label"] = part.points, part.labels
        rows["color"][:, self.color_order] = part.colors
        if self._intensity:
            rows["intensity"] = part.intensities
        rows.tofile(self._stream)
        self._num_points += len(rows)

    def close(self) -> None:
        """Write the header into the reserved bytes, padded with a comment, and close the file."""
        text = "".join(f"{line}\n" for line in self._header())
        spaces = HEADER_BYTES - len(text) - len(self.filler) - len(self.last_line) - 2
        self._stream.seek(0)
        self._stream.write(f"{text}{self.filler}{' ' * spaces}\n{self.last_line}\n".encode("ascii"))
        self._stream.close()

    def _header(self) -> list[str]:
        raise NotImplementedError


class PlyCloud(BinaryCloud):
    """Binary PLY: x y z (float32, m), red green blue, label (SemanticKITTI learning id), intensity if known."""

    row = (("xyz", "<f4", 3), ("color", "u1", 3), ("label", "u1"))
    color_order = 0, 1, 2
    filler, last_line = "comment", "end_header"

    def _header(self) -> list[str]:
        return [
            "ply",
            "format binary_little_endian 1.0",
            f"element vertex {self._num_points}",
            *(f"property float {name}" for name in "xyz"),
            *(f"property uchar {name}" for name in ("red", "green", "blue", "label")),
            *(f"property float {name}" for name in self._intensity),
        ]


class PcdCloud(BinaryCloud):
    """Binary PCD 0.7: x y z (float32, m), rgb packed as in PCL, label, intensity if known."""

    row = (("xyz", "<f4", 3), ("color", "u1", 4), ("label", "<u4"))
    color_order = 2, 1, 0
    filler, last_line = "#", "DATA binary"

    def _header(self) -> list[str]:
        names = ["x", "y", "z", "rgb", "label", *self._intensity]
        return [
            "VERSION 0.7",
            f"FIELDS {' '.join(names)}",
            f"SIZE{' 4' * len(names)}",
            f"TYPE {' '.join('U' if name == 'label' else 'F' for name in names)}",
            f"COUNT{' 1' * len(names)}",
            f"WIDTH {self._num_points}",
            "HEIGHT 1",
            "VIEWPOINT 0 0 0 1 0 0 0",
            f"POINTS {self._num_points}",
        ]


class LasCloud:
    """LAS 1.4, point format 7, in millimetres, with colours and ASPRS classes; compressed if the name ends in .laz.

    With the origin of the world frame on the globe, coordinates are UTM, with ellipsoidal heights. `user_data` holds
    the label (SemanticKITTI learning id). Intensities are scaled to 16 bits, as LAS requires.
    """

    def __init__(self, file: Path, store: "MapStore") -> None:
        import laspy  # type: ignore[import-untyped]  # an optional package

        self._laspy = laspy
        header = laspy.LasHeader(version="1.4", point_format=7)
        header.scales = np.full(3, 0.001)
        self._intensity_step = (store.tiles.brightest or 1.0) / 65535 if store.has_intensities else None
        self._projected: Callable[[Points], Points] = np.asarray
        if store.origin is not None:
            from pyproj import CRS

            from segslam.gnss.geodesy import utm

            epsg, self._projected = utm(store.origin)
            header.offsets = np.floor(self._projected(np.zeros((1, 3)))[0])
            header.add_crs(CRS.from_epsg(epsg))
        self._writer = laspy.open(file, mode="w", header=header)
        self._class_of_label = np.array([ASPRS_OF_LABEL.get(label, 1) for label in Label], np.uint8)

    def add(self, part: Part) -> None:
        """Append the points of a part."""
        record = self._laspy.ScaleAwarePointRecord.zeros(len(part.points), header=self._writer.header)
        record.x, record.y, record.z = self._projected(part.points.astype(np.float64)).T
        record.red, record.green, record.blue = 257 * part.colors.astype(np.uint16).T  # 255 to 65535
        record.classification, record.user_data = self._class_of_label[part.labels], part.labels
        if self._intensity_step is not None:
            record.intensity = np.rint(part.intensities / self._intensity_step).astype(np.uint16)
        self._writer.write_points(record)

    def close(self) -> None:
        """Complete the file."""
        self._writer.close()
