"""KITTI odometry (Geiger et al. 2012) and data of the same layout: scans, calibration, times, true poses, labels.

The number of a scan is that of its file. It is also its row in times.txt and in the poses; numbers may be missing. Pose
files hold poses of the left camera in the frame of the first; this module returns LiDAR poses.
"""

import math
from itertools import pairwise
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from segslam.core.errors import brief
from segslam.core.pose_files import read_poses
from segslam.core.trajectory import ROTATION_TOLERANCE, from_matrices, lidar_from_camera
from segslam.core.types import BadScan, Indices, SegslamError, Trajectory, Transform
from segslam.core.whole_files import read_text
from segslam.labels.label_files import open_labels
from segslam.scans.dataset import Cloud, Dataset, DataSource, check_num_lines, read_stamps, selected_rows
from segslam.scans.scan_files import read_bytes

VERTICAL_ANGLE_DEG = 0.205
"""Angle by which the points of KITTI's scans are too low; value of KISS-ICP (Vizzo et al., RA-L 2023)."""
FEWEST_COMPARED, MOST_COMPARED = 1_200, 40_000
"""Values of a file from which the number per point is found, and pairs of values that are compared."""
LEAST_ERRORS = 4.0
"""Chosen, in standard errors: least difference of two means that is not by chance (0.00003)."""
LIDAR_KEYS = ("Tr", "Tr_velo_to_cam", "Tr_velo_cam")
"""Names of T_camera_lidar in calib.txt, in KITTI's odometry, object and tracking benchmarks."""


class KittiSequence(Dataset):
    """The selected scans of one drive, one row per scan."""

    def __init__(self, source: DataSource) -> None:
        """The sequence of a folder with `sequences/`, or the folder itself if it is a sequence.

        Raises SegslamError if the sequence, its scans, its calibration or its times are missing.
        """
        folder, poses_file = _find_sequence(source.data, source.sequence)
        velodyne = folder / "velodyne"
        files, numbers = _numbered_scans(velodyne)
        stamps = read_stamps(folder / "times.txt")
        if numbers[-1] >= len(stamps):
            raise SegslamError(
                f"{folder / 'times.txt'}: {len(stamps)} lines, but there is a scan {numbers[-1]}; line n + 1 is the "
                "time of scan n"
            )
        self.T_camera_lidar = read_calibration(folder / "calib.txt")
        rows = selected_rows(numbers, source.frames, velodyne)
        self.name = f"kitti/{folder.name}"
        self.scan_files = [files[row] for row in rows]
        self.names = [file.stem for file in self.scan_files]
        self.scan_index = numbers[rows]
        self.stamp_ns = stamps[self.scan_index]
        self.num_recorded = len(stamps)
        self.labels = open_labels(source.labels, beside=folder, scan_names=self.names, encoding=source.encoding)
        self.reference = None
        if poses_file.exists():
            poses = lidar_from_camera(read_poses(poses_file, format="kitti").T_a_b, self.T_camera_lidar)
            check_num_lines(poses_file, len(poses), len(stamps))
            self.reference = Trajectory(self.scan_index, self.stamp_ns, poses[self.scan_index])
        self.vertical_angle_deg = VERTICAL_ANGLE_DEG if source.vertical_angle_deg is None else source.vertical_angle_deg
        self._has_intensities = source.intensities

    def _read(self, row: int) -> tuple[Path, int, Cloud]:
        returns = read_returns(self.scan_files[row])
        return self.scan_files[row], int(self.stamp_ns[row]), Cloud(returns[:, :3], intensities=returns[:, 3])


def is_kitti(data: Path) -> bool:
    """True if the folder contains KITTI sequences, or is one."""
    return (data / "sequences").is_dir() or _is_sequence(data)


def read_returns(file: Path) -> Float32[np.ndarray, "_ 4"]:
    """(n, 4) x, y, z, intensity of a velodyne file, as stored. Raises BadScan if it is invalid."""
    content = read_bytes(file)
    if _is_float64(content):
        raise BadScan(
            f"{file}: its values are not float32 (x y z intensity) but like float64; if x y z come first, 4 values per "
            "point, convert it in Python: numpy.save('NAME.npy', numpy.fromfile('NAME.bin', '<f8').reshape(-1, 4))"
        )
    values = np.frombuffer(content[: len(content) // 4 * 4], dtype="<f4")
    if (num := _values_per_point(values)) != 4:
        raise BadScan(
            f"{file}: does not have 4 values per point (x y z intensity) but {num}; if x y z come first, convert it "
            f"in Python: numpy.save('NAME.npy', numpy.fromfile('NAME.bin', '<f4').reshape(-1, {num}))"
        )
    if len(content) % 16:
        raise BadScan(
            f"{file}: {len(content)} bytes are not a multiple of 16 (float32 x y z intensity): truncated, or not 4 "
            "values per point; copy the file again, or convert it"
        )
    return values.reshape(-1, 4)


def _is_float64(content: bytes) -> bool:
    """True for values of 8 bytes: read as float32, half of them are the last digits of numbers, with any exponent.

    Their binary logarithms then spread by more than the digits of a float32 (standard deviation), and by less than an
    eighth of that if read as float64, whose exponent has 11 bits; numbers with 8 bits would spread eight times as much.
    """
    values = np.frombuffer(content[: len(content) // 8 * 8], "<f8")
    values = values[:: max(len(values) // MOST_COMPARED, 1)].copy()
    known = (read[np.isfinite(read) & (read != 0.0)] for read in (values.view("<f4"), values))
    as_single, as_double = (np.log2(np.abs(one)).std(dtype=float) if len(one) else 0.0 for one in known)
    return bool(8.0 * as_double < as_single > np.finfo(np.float32).nmant)


def _values_per_point(values: Float32[np.ndarray, " _"]) -> int:
    """The distance in the file, 3 to 7, at whose multiples values differ least in the mean; 4 if none is significant.

    There both values are of one column, so their mean difference is smallest: the energy distance of distributions is
    not negative (Szekely and Rizzo 2013). Values of random points are compared: neighbours may be on opposite sides.
    """
    if len(values) < FEWEST_COMPARED:
        return 4
    rng, size = np.random.default_rng(0), min(len(values), MOST_COMPARED)
    first = rng.integers(len(values) // 4 * 4, size=size)
    means, variances = {}, {}
    for num in (4, 3, 5, 6, 7):
        if num == 4 or len(values) % num == 0:
            second = num * rng.integers(len(values) // num, size=size) + first % num
            pairs = np.nan_to_num(values[[first, second]], posinf=0.0, neginf=0.0).astype(float)
            differences = np.abs(pairs[0] - pairs[1])
            means[num], variances[num] = float(differences.mean()), float(differences.var()) / size

    def is_smaller(num: int, other: int) -> bool:
        return means[other] - means[num] > LEAST_ERRORS * math.sqrt(variances[num] + variances[other])

    num = min(means, key=means.__getitem__)
    if not is_smaller(num, 4):
        return 4
    return 3 if num == 6 and not is_smaller(6, 3) else num


def read_calibration(file: Path) -> Transform:
    """T_camera_lidar of a calib.txt. Raises SegslamError if the file or the entry is missing or invalid."""
    return parse_calibration(read_text(file, "calibration", "put KITTI's calib.txt there"), file)


def parse_calibration(text: str, file: Path) -> Transform:
    """T_camera_lidar of the text of a calib.txt, as `read_calibration`; `file` is its name in messages."""
    for number, line in enumerate(text.splitlines(), start=1):
        key, _, values = line.replace(":", " ", 1).strip().partition(" ")
        if key in LIDAR_KEYS:
            return _rigid(values.split(), f"{file}:{number}")
    raise SegslamError(
        f"{file}: no line begins with any of {', '.join(LIDAR_KEYS)}; add KITTI's line `Tr:` with 12 numbers"
    )


def _rigid(texts: list[str], place: str) -> Transform:
    try:
        matrix = np.array(texts, dtype=float).reshape(3, 4)
    except ValueError as error:
        raise SegslamError(f"{place}: expected 12 numbers, a 3x4 matrix by rows ({brief(str(error))})") from error
    if not np.isfinite(matrix).all():
        raise SegslamError(f"{place}: all numbers must be finite")
    (T_camera_lidar,), (off,) = from_matrices(matrix)
    if not off <= ROTATION_TOLERANCE:
        raise SegslamError(
            f"{place}: the 3x3 part is not a rotation (error {off:.3g}); give the transform from LiDAR to camera "
            "coordinates, not a projection"
        )
    return T_camera_lidar


def _is_sequence(folder: Path) -> bool:
    return (folder / "velodyne").is_dir() and ((folder / "calib.txt").exists() or folder.parent.name == "sequences")


def _find_sequence(data: Path, sequence: str) -> tuple[Path, Path]:
    """Folder of the sequence, and file of its true poses, which may be missing."""
    if not isinstance(sequence, str):
        raise SegslamError(f"sequence {sequence!r}: give a text, for example '00'")
    if not (data / "sequences").is_dir() and _is_sequence(data):
        folder = data.resolve()
        if folder.parent.name == "sequences" and sequence.zfill(2) not in ("00", folder.name):
            raise SegslamError(f"--sequence {sequence}: {data} is another one; omit the option, or give {data}/../..")
        return folder, folder.parent.parent / "poses" / f"{folder.name}.txt"
    name = sequence.zfill(2)
    folder = data / "sequences" / name
    if not folder.is_dir():
        known = ", ".join(sorted(other.name for other in (data / "sequences").glob("*") if other.is_dir())) or "none"
        raise SegslamError(f"{folder}: no such sequence; {data / 'sequences'} has: {known}")
    return folder, data / "poses" / f"{name}.txt"


def _numbered_scans(velodyne: Path) -> tuple[list[Path], Indices]:
    files = [file for file in velodyne.glob("*.bin") if not file.name.startswith(".")]
    if not files:
        raise SegslamError(f"{velodyne}: contains no .bin file; put KITTI's scans there, 000000.bin and so on")
    misnamed = [file for file in files if not file.stem.isdecimal() or int(file.stem) >= 2**63]
    if misnamed:
        raise SegslamError(f"{misnamed[0]}: the name is not a scan number; rename the file, for example 000000.bin")
    files.sort(key=lambda file: (int(file.stem), file.stem))
    for file, following in pairwise(files):
        if int(file.stem) == int(following.stem):
            raise SegslamError(f"{file}: has the same number as {following.name}; leave one of the two out")
    return files, np.array([int(file.stem) for file in files])
