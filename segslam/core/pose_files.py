"""Pose files in KITTI and TUM format, and in that of other programs whose columns have names.

A pose file does not name its frames: the reader returns T_a_b as stored in the lines.
"""

import re
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation as ScipyRotation

from segslam.core.errors import brief
from segslam.core.stamps import nanoseconds
from segslam.core.trajectory import LARGEST, NOT_FINITE, ROTATION_TOLERANCE, Poses, from_matrices, from_quaternions
from segslam.core.types import Indices, SegslamError
from segslam.core.whole_files import read_text

PoseFormat = Literal["kitti", "tum"]
COLUMNS: dict[PoseFormat, int] = {"kitti": 12, "tum": 8}
LAYOUT: dict[PoseFormat, str] = {
    "kitti": "KITTI format has 12 numbers per line, a 3x4 matrix by rows",
    "tum": "TUM format has 8 numbers per line: seconds x y z qx qy qz qw",
}
TIME = re.compile("time|stamp|sec|^t$")
"""Names of the time in other files: a first column without it may be a number of the pose (MCD, Oxford Spires)."""
QUATERNION_LAST = {"xyzxyzw": (0, 1, 2, 3, 4, 5, 6), "xyzwxyz": (0, 1, 2, 4, 5, 6, 3)}
"""Last letters of the names of columns, and where x y z qx qy qz qw are among them."""


@dataclass(frozen=True, slots=True, eq=False)
class PoseFile:
    """Content of a pose file, one row per pose, in the file's own frames."""

    T_a_b: Poses
    stamp_ns: Indices | None
    """None in KITTI format, where the row is the number of the scan."""

    def __len__(self) -> int:
        return len(self.T_a_b)


class _Named(NamedTuple):
    """The columns of a file that names them; the first is the time, or the second after a number of the pose."""

    places: tuple[int, ...]
    """Those of x y z qx qy qz qw."""
    num_columns: int
    time: int
    is_ns: bool
    """True if the time is in nanoseconds by its name."""
    has_ns_beside: bool
    """True if the column after the time has the nanoseconds of a time in whole seconds."""

    def ordered(self, fields: list[str]) -> list[str]:
        """The fields in the order of TUM format. Raises ValueError for another number of columns, or of no time."""
        if len(fields) != self.num_columns:
            raise ValueError(f"found {len(fields)} columns, but the line of names has {self.num_columns}")
        time = fields[self.time]
        try:
            if self.is_ns:
                time = str(Decimal(time).scaleb(-9))
            elif self.has_ns_beside:
                time = str(Decimal(time) + Decimal(fields[self.time + 1]).scaleb(-9))
        except ArithmeticError as error:
            raise ValueError(f"{brief(' '.join(fields[self.time :][:2]))} is not a time") from error
        return [time, *(fields[place] for place in self.places)]


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
    poses, off = from_matrices(rows) if chosen == "kitti" else from_quaternions(rows[:, 1:])
    worst = int(np.argmax(off))
    if off[worst] > ROTATION_TOLERANCE:
        what = "3x3 part" if chosen == "kitti" else "quaternion"
        raise SegslamError(
            f"{path}:{lines[worst][0]}: the {what} is not a rotation (error {off[worst]:.3g}); correct the line"
        )
    return PoseFile(poses, np.array(stamps, dtype=np.int64) if chosen == "tum" else None)


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
    time = int(bool(TIME.search(names[1])) and not TIME.search(names[0]))
    places = [place for place, name in enumerate(names) if place and name.endswith(tuple("xyzw"))]
    return _Named(
        tuple(places[k] for k in order),
        len(names),
        time,
        is_ns=bool(re.search(r"(?<![a-z])ns$|nanosec", names[time])),
        has_ns_beside=bool(re.fullmatch(r"n(ano)?secs?", names[time + 1])),
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
