"""What is written in any valid form is read as it was."""

from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace

import hypothesis.strategies as some
import numpy as np
from hypothesis import assume, given, settings

from fuzz import seeds
from segslam.core.config import Config, config_to_yaml, load_config
from segslam.core.pose_files import read_poses, write_kitti, write_tum
from segslam.scans.clouds import read_file
from segslam.scans.dataset import read_stamps
from segslam.scans.pcd import decompress
from segslam.scans.point_cloud2 import read_message

steady = settings(derandomize=True, deadline=None, max_examples=60)
KINDS = ("<f4", "<f8", "<i2", "<u2", "|u1", "<u4")


@some.composite
def tables(draw: some.DrawFn) -> np.ndarray:
    """Points with x, y and z of one type, and other fields, in any order."""
    axes = draw(some.sampled_from(("<f4", "<f8", "<i2")))
    others = draw(some.dictionaries(some.sampled_from(("intensity", "ring", "time", "q")), some.sampled_from(KINDS)))
    fields = draw(some.permutations([*((axis, axes) for axis in "xyz"), *others.items()]))
    dtype = np.dtype([(name, "<u2" if kind == "<i2" and name not in "xyz" else kind) for name, kind in fields])
    return seeds.rows(dtype, draw(some.integers(1, 50)), draw(some.integers(0, 9)))


def _assert_equal(file: Path, rows: np.ndarray) -> None:
    cloud = read_file(file)
    np.testing.assert_array_equal(cloud.points, np.column_stack([rows[axis] for axis in "xyz"]))
    names = rows.dtype.names or ()
    assert (cloud.intensities is None) == ("intensity" not in names)
    if cloud.intensities is not None:
        np.testing.assert_array_equal(cloud.intensities, rows["intensity"])
    np.testing.assert_array_equal(cloud.times, rows["time"] if "time" in names else [])


@steady
@given(tables(), some.sampled_from(seeds.FORMATS))
def test_ply_reads_as_written(rows: np.ndarray, form: str) -> None:
    with TemporaryDirectory() as folder:
        file = Path(folder) / "0.ply"
        file.write_bytes(seeds.ply(rows, form))
        _assert_equal(file, rows)


@steady
@given(tables(), some.sampled_from(seeds.ENCODINGS))
def test_pcd_reads_as_written(rows: np.ndarray, form: str) -> None:
    with TemporaryDirectory() as folder:
        file = Path(folder) / "0.pcd"
        file.write_bytes(seeds.pcd(rows, form))
        _assert_equal(file, rows)


@steady
@given(
    some.integers(1, 50), some.integers(3, 6), some.sampled_from(["<f4", ">f4", "<f8", "<i4", "<u2"]), some.booleans()
)
def test_npy_reads_as_written(num: int, columns: int, kind: str, by_columns: bool) -> None:
    values = np.random.default_rng(num).uniform(0, 90, (num, columns)).astype(kind)
    with TemporaryDirectory() as folder:
        file = Path(folder) / "0.npy"
        np.save(file, np.asfortranarray(values) if by_columns else values)
        cloud = read_file(file)
    np.testing.assert_array_equal(cloud.points, values[:, :3])
    assert (cloud.intensities is None) == (columns == 3)
    if cloud.intensities is not None:
        np.testing.assert_array_equal(cloud.intensities, values[:, 3])


@steady
@given(some.binary(max_size=600).map(lambda data: data[:300] + data[:1] * 20 + data[300:]))
def test_compressed_bytes_come_back(data: bytes) -> None:
    assert bytes(decompress(seeds.lzf(data), len(data))) == data


@steady
@given(tables(), some.integers(1, 5), some.integers(0, 7), some.booleans())
def test_messages_read_as_written(rows: np.ndarray, height: int, padding: int, big: bool) -> None:
    rows = rows[: len(rows) // height * height]
    assume(len(rows) > 0)
    width = len(rows) // height
    stored = rows.astype(rows.dtype.newbyteorder(">")) if big else rows
    data = b"".join(line.tobytes() + bytes(padding) for line in stored.reshape(height, width))
    step = rows.dtype.itemsize
    values = seeds.message(
        rows, height=height, width=width, row_step=width * step + padding, is_bigendian=big, data=data
    )
    fields = [SimpleNamespace(**field) for field in values.pop("fields")]
    header = SimpleNamespace(stamp=SimpleNamespace(sec=3, nanosec=7))
    cloud = read_message(SimpleNamespace(header=header, fields=fields, **values))
    np.testing.assert_array_equal(cloud.points, np.column_stack([rows[axis] for axis in "xyz"]))
    np.testing.assert_array_equal(cloud.times, rows["time"] if "time" in (rows.dtype.names or ()) else [])
    assert cloud.stamp_ns == 3_000_000_007


@steady
@given(some.lists(some.integers(0, 2**62), min_size=1, unique=True).map(sorted))
def test_times_and_stamps_read_to_the_nanosecond(stamps: list[int]) -> None:
    poses = np.tile(np.eye(4), (len(stamps), 1, 1))
    with TemporaryDirectory() as folder:
        file = Path(folder) / "poses.txt"
        write_tum(file, np.array(stamps), poses)
        np.testing.assert_array_equal(read_poses(file).stamp_ns, stamps)
        write_kitti(file, poses)
        np.testing.assert_array_equal(read_poses(file).T_a_b, poses)
        file.write_text("".join(f"{stamp // 10**9}.{stamp % 10**9:09d}\n" for stamp in stamps))
        np.testing.assert_array_equal(read_stamps(file), stamps)


@steady
@given(some.floats(0.1, 100.0), some.booleans(), some.sampled_from(["none", "gnc", "consistent"]))
def test_settings_read_as_written(distance_m: float, deskew: bool, final: str) -> None:
    texts = [f"keyframes.distance_m={distance_m!r}", f"odometry.deskew={deskew}", f"graph.final={final}"]
    config = load_config(None, texts)
    assert (config.keyframes.distance_m, config.odometry.deskew, config.graph.final) == (distance_m, deskew, final)
    with TemporaryDirectory() as folder:
        file = Path(folder) / "config.yaml"
        file.write_text(config_to_yaml(config))
        assert load_config(file) == config != Config()
