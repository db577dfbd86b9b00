"""KITTI and TUM pose files, matching of their rows, and the poses of all scans from the poses of keyframes.

A pose file does not name its frames: the reader returns T_a_b as stored in the lines.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from decimal import Decimal
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation as ScipyRotation

from segslam.core import geometry
from segslam.core.errors import brief
from segslam.core.types import IndexPairs, Indices, Mask, SegslamError, Transform, Vector
from segslam.core.whole_files import read_text

Poses = Float[np.ndarray, "_ 4 4"]
"""Rigid transforms T_a_b, one per row."""
PoseFormat = Literal["kitti", "tum"]
COLUMNS: dict[PoseFormat, int] = {"kitti": 12, "tum": 8}
LAYOUT: dict[PoseFormat, str] = {
    "kitti": "KITTI format has 12 numbers per line, a 3x4 matrix by rows",
    "tum": "TUM format has 8 numbers per line: seconds x y z qx qy qz qw",
}
ROTATION_TOLERANCE = 0.01  # chosen: above the rounding in files, far below the error of other matrices
LARGEST = float(np.finfo(np.float32).max)
"""Largest number of a pose or a graph: a point has no larger coordinates, and products of larger ones overflow."""
QUATERNION_LAST = {"xyzxyzw": (0, 1, 2, 3, 4, 5, 6), "xyzwxyz": (0, 1, 2, 4, 5, 6, 3)}
"""Last letters of the names of columns, and where x y z qx qy qz qw are among them."""
DECIMALS = (9, 6, 3, 0)
"""Those between nanoseconds and seconds, ms, us and ns."""
EARLIEST_S, LATEST_S = 1_000_000_000, 4_000_000_000
"""Years 2001 and 2096: a larger number that is between them in ms, us or ns is taken for such a time."""
NOT_FINITE = f"every number must be finite, at most {LARGEST:.2g}"


@dataclass(frozen=True, slots=True, eq=False)
class PoseFile:
    """Content of a pose file, one row per pose, in the file's own frames."""

    T_a_b: Poses
    stamp_ns: Indices | None
    """None in KITTI format, where the row is the number of the scan."""

    def __len__(self) -> int:
        return len(self.T_a_b)


class _Named(NamedTuple):
    """The columns of a file that names them; the first is the time."""

    places: tuple[int, ...]
    """Those of x y z qx qy qz qw."""
    num_columns: int
    is_ns: bool
    """True if the time is in nanoseconds by its name."""
    has_ns_beside: bool
    """True if the second column has the nanoseconds of a time in whole seconds."""

    def ordered(self, fields: list[str]) -> list[str]:
        """The fields in the order of TUM format. Raises ValueError for another number of columns, or of no time."""
        if len(fields) != self.num_columns:
            raise ValueError(f"found {len(fields)} columns, but the line of names has {self.num_columns}")
        time = fields[0]
        try:
            if self.is_ns:
                time = str(Decimal(time).scaleb(-9))
            elif self.has_ns_beside:
                time = str(Decimal(time) + Decimal(fields[1]).scaleb(-9))
        except ArithmeticError as error:
            raise ValueError(f"{brief(' '.join(fields[:2]))} is not a time") from error
        return [time, *(fields[place] for place in self.places)]


class Rows:
    """An array that grows by rows of one shape. Arrays returned by `all` do not change: rows are only appended."""

    def __init__(self, rows: np.ndarray) -> None:
        self._rows = rows
        self._num = len(rows)

    def __len__(self) -> int:
        return self._num

    def append(self, row: np.ndarray | float) -> None:
        """Add a row; amortised constant time."""
        if self._num == len(self._rows):
            longer = np.empty((max(16, 2 * self._num), *self._rows.shape[1:]), self._rows.dtype)
            longer[: self._num] = self._rows
            self._rows = longer
        self._rows[self._num] = row
        self._num += 1

    def all(self) -> np.ndarray:
        """A read-only view of the rows so far."""
        view = self._rows[: self._num]
        view.flags.writeable = False
        return view


def read_poses(path: Path, *, format: PoseFormat | None = None, skips_names: bool = False) -> PoseFile:
    """The poses of a KITTI or TUM file with exact rotations; by default the format is detected from the columns.

    Empty lines, text after a #, and a first line of column names (of a .csv file, or with `skips_names`) are ignored.
    Names, also in a comment before the first pose, may show other columns than those of TUM format: w first, more
    columns at the end, and times in nanoseconds or with nanoseconds beside them (EuRoC, Newer College).
    Raises SegslamError, naming the file and line, for another number of columns, numbers that are not finite, and
    matrices or quaternions that are not rotations.
    """
    lines, named = _lines_and_names(path, skips_names=skips_names or path.suffix.lower() == ".csv")
    if format == "kitti":
        named = None
    first, fields = lines[0]
    chosen = "tum" if named else format or next((one for one, num in COLUMNS.items() if len(fields) == num), None)
    if chosen is None:
        raise SegslamError(f"{path}:{first}: found {len(fields)} numbers; {LAYOUT['kitti']}, {LAYOUT['tum']}")
    numbers, stamps = [], []
    for line, fields in lines:
        try:
            ordered = named.ordered(fields) if named else fields
            numbers.append(_numbers(ordered, chosen))
            stamps.append(nanoseconds(ordered[0]) if chosen == "tum" else 0)
        except ValueError as error:
            raise SegslamError(f"{path}:{line}: {error}; correct or remove the line") from error
    rows = np.array(numbers)
    poses, off = _from_matrices(rows) if chosen == "kitti" else from_quaternions(rows[:, 1:])
    worst = int(np.argmax(off))
    if off[worst] > ROTATION_TOLERANCE:
        what = "3x3 part" if chosen == "kitti" else "quaternion"
        raise SegslamError(
            f"{path}:{lines[worst][0]}: the {what} is not a rotation (error {off[worst]:.3g}); correct the line"
        )
    return PoseFile(poses, np.array(stamps, dtype=np.int64) if chosen == "tum" else None)


def as_poses(given: object, name: str) -> Poses:
    """Poses of an array-like object, (n, 4, 4). Raises SegslamError, with the name, for anything else."""
    try:
        poses = np.asarray(given, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise SegslamError(f"{name}: {brief(str(given))} is no array; give finite matrices, (n, 4, 4)") from error
    if poses.ndim != 3 or poses.shape[1:] != (4, 4) or not (np.abs(poses) <= LARGEST).all():
        raise SegslamError(f"{name}: poses of shape {poses.shape}; give finite matrices, (n, 4, 4)")
    off = np.abs(poses[:, 3] - [0.0, 0.0, 0.0, 1.0]).max(initial=0.0)
    if len(poses) and max(off, _from_matrices(poses[:, :3])[1].max()) > ROTATION_TOLERANCE:
        raise SegslamError(f"{name}: a matrix is not a pose: a rotation and a translation, then the row 0 0 0 1")
    return poses


def write_kitti(path: Path, T_a_b: Poses) -> None:
    """Write one pose per line, 12 numbers, as read by evo's `kitti`. The poses must be in the frame of the file."""
    np.savetxt(path, T_a_b[:, :3].reshape(-1, 12), fmt="%.12g")


def write_tum(path: Path, stamp_ns: Indices, T_a_b: Poses) -> None:
    """Write one pose per line, `seconds x y z qx qy qz qw`, with stamps to the nanosecond, as read by evo's `tum`."""
    quaternions = ScipyRotation.from_matrix(T_a_b[:, :3, :3]).as_quat().reshape(-1, 4)
    rows = np.hstack([T_a_b[:, :3, 3], quaternions])
    lines = [
        f"{Decimal(int(stamp)).scaleb(-9):f} " + " ".join(f"{value:.12g}" for value in row)
        for stamp, row in zip(stamp_ns, rows, strict=True)
    ]
    path.write_text("".join(line + "\n" for line in lines), encoding="ascii")


def nanoseconds(seconds: str) -> int:
    """The stamp (ns) of a text, exactly; a double cannot represent it. Raises ValueError if it is not a time.

    A number that is too large for seconds may be a time from 2001 to 2096 in ms, us or ns.
    """
    try:
        time = Decimal(seconds)
        fitting = (num for num in DECIMALS if EARLIEST_S <= time.scaleb(num - 9) < LATEST_S)
        stamp_ns = int(time.scaleb(next(fitting, DECIMALS[0])).to_integral_value())
    except (ArithmeticError, ValueError) as error:
        raise ValueError(f"{brief(seconds)} is not a time in seconds") from error
    if abs(stamp_ns) >= 2**63:
        raise ValueError(f"{brief(seconds)} s are more than 292 years")
    return stamp_ns


def dated_nanoseconds(text: str) -> int:
    """The stamp (ns) of a date and time in UTC, `2011-09-30 12:40:25.072360123`. Raises ValueError for another text."""
    whole, _, fraction = text.partition(".")
    since = datetime.fromisoformat(whole).replace(tzinfo=UTC) - datetime(1970, 1, 1, tzinfo=UTC)
    return (since.days * 86_400 + since.seconds) * 1_000_000_000 + int(fraction.ljust(9, "0")[:9])


def camera_from_lidar(T_world_lidar: Poses, T_camera_lidar: Transform) -> Poses:
    """LiDAR poses as KITTI stores them: poses of the camera in the frame of the first camera."""
    return T_camera_lidar @ T_world_lidar @ geometry.inverse(T_camera_lidar)


def lidar_from_camera(T_world_camera: Poses, T_camera_lidar: Transform) -> Poses:
    """LiDAR poses in the frame of the first, from poses as KITTI stores them; undoes `camera_from_lidar`."""
    return geometry.inverse(T_camera_lidar) @ T_world_camera @ T_camera_lidar


def rows_of_same_stamp(stamp_ns_a: Indices, stamp_ns_b: Indices, *, max_difference_ns: int) -> IndexPairs:
    """Rows (of a, of b) that are mutually nearest in time and at most `max_difference_ns` apart; ascending in a."""
    if len(stamp_ns_a) == 0 or len(stamp_ns_b) == 0:
        return np.empty((0, 2), dtype=np.int64)
    nearest_b = nearest_rows(stamp_ns_b, stamp_ns_a)
    nearest_a = nearest_rows(stamp_ns_a, stamp_ns_b)
    rows_a = np.arange(len(stamp_ns_a))
    mutual = nearest_a[nearest_b] == rows_a
    close = np.abs(stamp_ns_b[nearest_b] - stamp_ns_a) <= max_difference_ns
    return np.column_stack([rows_a, nearest_b])[mutual & close]


def rows_of_same_scan(scan_index_a: Indices, scan_index_b: Indices) -> IndexPairs:
    """Rows (of a, of b) of the same scan, ascending in the scan's number."""
    _, rows_a, rows_b = np.intersect1d(scan_index_a, scan_index_b, return_indices=True)
    return np.column_stack([rows_a, rows_b])


def travelled_m(T_a_b: Poses, begun: Indices | Sequence[int] = ()) -> np.ndarray:
    """(n,) length of the path from the first pose to each pose (m), without the ways to those of the rows `begun`."""
    steps = np.linalg.norm(np.diff(T_a_b[:, :3, 3], axis=0), axis=1)
    steps[[row - 1 for row in begun if 0 < row < len(T_a_b)]] = 0.0
    return np.concatenate([np.zeros(min(1, len(T_a_b))), np.cumsum(steps)])


def begun_among(rows: Indices, begun: Indices) -> Indices:
    """The rows among some scans, themselves `rows`, before which another drive begins."""
    firsts = np.unique(np.searchsorted(rows, begun))
    return firsts[(firsts > 0) & (firsts < len(rows))]


def parted(values: np.ndarray, begun: Indices | Sequence[int]) -> np.ndarray:
    """Values (n, ...) with one of NaN before each of these rows: a line through them is drawn with gaps there."""
    return np.insert(values.astype(np.float64), np.asarray(begun, np.int64), np.nan, axis=0)


def corrected_poses(
    T_odom_lidar: Poses, keyframe_rows: Indices, T_world_keyframe: Poses, *, after_break: Mask | None = None
) -> Poses:
    """T_world_lidar of every scan, from the odometry of every scan and the corrected poses of the keyframes.

    The keyframes before and after a scan each predict its pose by the odometry between them. The two predictions are
    blended on SE(3) by the share of the way travelled. Only the nearest keyframe is used before the first and after the
    last, and only the keyframe before if the next one follows a break (`after_break`, one value per keyframe).
    `keyframe_rows` must ascend. Raises ValueError without keyframes, or for another number of poses.
    """
    if len(keyframe_rows) == 0 or len(keyframe_rows) != len(T_world_keyframe):
        raise ValueError(f"{len(keyframe_rows)} keyframes and {len(T_world_keyframe)} poses of keyframes")
    corrections = [
        T_world_k @ geometry.inverse(T_odom_lidar[row])
        for row, T_world_k in zip(keyframe_rows, T_world_keyframe, strict=True)
    ]
    before, after, share = _surroundings(keyframe_rows, travelled_m(T_odom_lidar))
    if after_break is not None:
        share = np.where(after_break[after], 0.0, share)
    poses = [
        geometry.interpolate(corrections[k] @ T_odom_s, corrections[m] @ T_odom_s, fraction)
        for T_odom_s, k, m, fraction in zip(T_odom_lidar, before, after, share, strict=True)
    ]
    T_world_lidar = np.array(poses)
    T_world_lidar[keyframe_rows] = T_world_keyframe
    return T_world_lidar


def _surroundings(keyframe_rows: Indices, travel_m: np.ndarray) -> tuple[Indices, Indices, np.ndarray]:
    """For each scan: the keyframe before it, the one after it, and the share of the way between them, 0 to 1."""
    rows = np.arange(len(travel_m))
    last = len(keyframe_rows) - 1
    position = np.searchsorted(keyframe_rows, rows, side="right")
    before, after = np.clip(position - 1, 0, last), np.clip(position, 0, last)
    standing = 1e-9 * rows  # where the sensor does not move, the share is that of the scans
    progress = travel_m + standing
    start, end = progress[keyframe_rows[before]], progress[keyframe_rows[after]]
    share = (progress - start) / np.where(before == after, 1.0, end - start)
    return before, after, np.clip(share, 0.0, 1.0)


def nearest_rows(values: np.ndarray, targets: np.ndarray) -> Indices:
    """(n,) row of the value that is nearest to each target, the smaller one of two; there is a value at least."""
    order = np.argsort(values, kind="stable")
    ascending = values[order]
    right = np.clip(np.searchsorted(ascending, targets), min(1, len(values) - 1), len(values) - 1)
    left = np.maximum(right - 1, 0)
    closer_left = np.abs(ascending[left] - targets) <= np.abs(ascending[right] - targets)
    return order[np.where(closer_left, left, right)]


def _lines_and_names(path: Path, *, skips_names: bool) -> tuple[list[tuple[int, list[str]]], _Named | None]:
    """(line number, fields) of each line with content, and its columns if they have names.

    `skips_names`: the first line may have names; others than of TUM format must not show another order.
    """
    texts = read_text(path, "poses", "give a KITTI or TUM trajectory").split("\n")
    split = ((number, _fields(text.partition("#")[0])) for number, text in enumerate(texts, 1))
    lines = [(number, fields) for number, fields in split if fields != [""]]
    if not lines:
        raise SegslamError(f"{path}: contains no pose; {LAYOUT['kitti']}, {LAYOUT['tum']}")
    number, fields = lines[0]
    if skips_names and len(lines) > 1 and not re.match(r"[-+.\d]", fields[0]):
        names = _names(texts[number - 1])
        named = _named(names)
        if named is None and not "xyzxyzw".startswith(_axes(names)):
            raise SegslamError(
                f"{path}:{number}: its columns are {brief(' '.join(names))}; reorder them: {LAYOUT['tum']}"
            )
        return lines[1:], named
    comments = [text for text in texts[: number - 1] if text.lstrip().startswith("#")]
    named = _named(_names(comments[-1])) if comments else None
    return lines, named if named and named.num_columns == len(fields) else None


def _names(line: str) -> list[str]:
    """The names of columns in small letters, without their units but that of nanoseconds."""
    line = re.sub(r"\s*[\[(](.*?)[\])]", lambda unit: "_ns" * (unit[1].strip() == "ns"), line.lower())
    return _fields(line.strip("#,; \t\r"))


def _axes(names: list[str]) -> str:
    """The last letters of the names, but the first, that end in x, y, z or w."""
    return "".join(name[-1] for name in names[1:] if name.endswith(tuple("xyzw")))


def _named(names: list[str]) -> _Named | None:
    """The columns of TUM format; None if the names do not show them."""
    order = QUATERNION_LAST.get(_axes(names)[:7])
    if order is None or names[0].endswith(tuple("xyzw")):
        return None
    places = [place for place, name in enumerate(names) if place and name.endswith(tuple("xyzw"))]
    return _Named(
        tuple(places[k] for k in order),
        len(names),
        is_ns=bool(re.search(r"(?<![a-z])ns$|nanosec", names[0])),
        has_ns_beside=bool(re.fullmatch(r"n(ano)?secs?", names[1])),
    )


def _fields(line: str) -> list[str]:
    """The fields of a line between blanks, commas, or semicolons; with semicolons, commas are decimal ones."""
    if ";" in line:
        line = line.replace(",", ".").replace(";", " ")
    return re.split(r"[\s,]+", line.strip())


def _numbers(fields: list[str], format: PoseFormat) -> list[float]:
    """Raises ValueError, with the reason, unless a line has as many finite numbers as the format."""
    if len(fields) != COLUMNS[format]:
        raise ValueError(f"found {len(fields)} numbers; {LAYOUT[format]}")
    try:
        values = [float(field) for field in fields]
    except ValueError as error:
        raise ValueError(f"{brief(str(error))}; {LAYOUT[format]}") from error
    if not all(abs(value) <= LARGEST for value in values):
        raise ValueError(f"{brief(' '.join(fields))}: {NOT_FINITE}")
    return values


def _from_matrices(rows: np.ndarray) -> tuple[Poses, Vector]:
    """The poses, and the distance of each 3x3 part from a rotation."""
    matrices = rows.reshape(-1, 3, 4)
    rotations = np.array([geometry.nearest_rotation(matrix) for matrix in matrices[:, :, :3]])
    off = np.abs(matrices[:, :, :3] - rotations).max(axis=(1, 2))
    return geometry.transforms(rotations, matrices[:, :, 3]), off


def from_quaternions(rows: np.ndarray) -> tuple[Poses, Vector]:
    """The poses of rows (n, 7) x y z qx qy qz qw, and the difference of each quaternion's length from 1."""
    norms = np.linalg.norm(rows[:, 3:], axis=1)
    quaternions = np.where(norms[:, None] > 0, rows[:, 3:], [0.0, 0.0, 0.0, 1.0])  # zeros are then rejected
    poses = geometry.transforms(ScipyRotation.from_quat(quaternions).as_matrix(), rows[:, :3])
    return poses, np.abs(norms - 1.0)
