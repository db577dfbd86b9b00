"""Scan files in all forms that programs write, read in the same way by every command; and files that are no scans."""

import os
from codecs import BOM_UTF8
from pathlib import Path

import numpy as np
import open3d as o3d
import pytest

from segslam.core.types import BadScan
from segslam.scans import open_dataset
from segslam.scans.clouds import read_file
from segslam.scans.pcd import _decompress
from segslam.scans.scan_files import Columns, Field, text_columns

NUM = 200
RNG = np.random.default_rng(0)
POINTS = RNG.uniform(-20, 20, (NUM, 3)).astype(np.float32)
INTENSITIES = np.arange(NUM).astype(np.float32)


def _ply(
    properties: str, rows: bytes, *, form: str = "binary_little_endian", before: str = "", end: str = "\n"
) -> bytes:
    lines = "".join(f"property {one}\n" for one in properties.split(", "))
    header = f"ply\nformat {form} 1.0\n{before}element vertex {NUM}\n{lines}end_header\n"
    return header.replace("\n", end).encode() + rows


def _pcd(columns: dict[str, str], rows: bytes, *, form: str = "binary", end: str = "\n", size: str = "") -> bytes:
    """`columns`: type, size and count of each field, such as F41."""
    lines = {
        "VERSION": "0.7",
        "FIELDS": " ".join(columns),
        "SIZE": " ".join(kind[1] for kind in columns.values()),
        "TYPE": " ".join(kind[0] for kind in columns.values()),
        "COUNT": " ".join(kind[2] for kind in columns.values()),
    }
    header = "".join(f"{key} {words}\n" for key, words in lines.items())
    header += size or f"WIDTH {NUM}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {NUM}\n"
    return (header + f"DATA {form}\n").replace("\n", end).encode() + rows


def _rows(**kinds: str) -> bytes:
    values = dict(zip("xyz", POINTS.T, strict=True)) | {"i": INTENSITIES}
    made = np.zeros(NUM, list(kinds.items()))
    for name in kinds.keys() & values.keys():
        made[name] = values[name]
    return made.tobytes()


XYZ, XYZI = _rows(x="<f4", y="<f4", z="<f4"), _rows(x="<f4", y="<f4", z="<f4", i="<f4")
FLOATS = {"x": "F41", "y": "F41", "z": "F41"}
FILES = {
    "doubles.ply": _ply("double x, double y, double z, uchar intensity", _rows(x="<f8", y="<f8", z="<f8", i="u1")),
    "big.ply": _ply(
        "float x, float y, float z, float intensity",
        _rows(x=">f4", y=">f4", z=">f4", i=">f4"),
        form="binary_big_endian",
    ),
    "windows.ply": _ply("float x, float y, float z", XYZ, end="\r\n"),
    "reversed.ply": _ply("float z, float y, float x", _rows(z="<f4", y="<f4", x="<f4")),
    "coloured.ply": _ply(
        "float x, float y, float z, uchar red, uchar green, uchar blue, float intensity",
        _rows(x="<f4", y="<f4", z="<f4", r="u1", g="u1", b="u1", i="<f4"),
    ),
    "camera first.ply": _ply(
        "float32 x, float32 y, float32 z",
        bytes(9) + XYZ,
        before="element camera 1\nproperty double a\nproperty char b\n",
    ),
    "faces after.ply": _ply("float x, float y, float z", XYZ).replace(
        b"end_header", b"element face 1\nproperty list uchar int vertex_indices\nend_header"
    )
    + b"\x03"
    + bytes(12),
    "doubles.pcd": _pcd(
        {"x": "F81", "y": "F81", "z": "F81", "intensity": "F41"}, _rows(x="<f8", y="<f8", z="<f8", i="<f4")
    ),
    "padded.pcd": _pcd(
        FLOATS | {"_": "U14", "intensity": "F41", "ring": "U21"},
        _rows(x="<f4", y="<f4", z="<f4", pad="V4", i="<f4", ring="<u2"),
    ),
    "bytes.pcd": _pcd(FLOATS | {"intensity": "U11"}, _rows(x="<f4", y="<f4", z="<f4", i="u1")),
    "normals.pcd": _pcd(
        FLOATS | {"normal": "F43", "intensity": "F41"}, _rows(x="<f4", y="<f4", z="<f4", n="(3,)<f4", i="<f4")
    ),
    "organised.pcd": _pcd(FLOATS, XYZ, size=f"WIDTH {NUM // 2}\nHEIGHT 2\nPOINTS {NUM}\n"),
    "only the points.pcd": _pcd(FLOATS, XYZ, size=f"WIDTH 0\nHEIGHT 0\nPOINTS {NUM}\n"),
    "without points.pcd": _pcd(FLOATS, XYZ, size=f"WIDTH {NUM}\nHEIGHT 1\n"),
    "windows.pcd": _pcd(FLOATS, XYZ, end="\r\n"),
    "reversed.pcd": _pcd(
        {"intensity": "F41", "z": "F41", "y": "F41", "x": "F41"}, _rows(i="<f4", z="<f4", y="<f4", x="<f4")
    ),
    "padded to a block.pcd": _pcd(FLOATS, XYZ + bytes(11)),
    "marked.ply": BOM_UTF8 + _ply("float x, float y, float z", XYZ),
    "marked.pcd": BOM_UTF8 + _pcd(FLOATS, XYZ),
    "capitals.PCD": _pcd(FLOATS, XYZ, form="BINARY"),
    "capitals.PLY": _ply("float x, float y, float z", XYZ),
}


@pytest.mark.parametrize("name", FILES)
def test_every_form_gives_map_and_live_the_same_points(tmp_path: Path, name: str) -> None:
    file = tmp_path / name
    file.write_bytes(FILES[name])
    scan = open_dataset(tmp_path, intensities=True)[0]
    for points, intensities in ((read_file(file).points, read_file(file).intensities), (scan.points, scan.intensities)):
        np.testing.assert_array_equal(points, POINTS)
        if b"intensity" not in FILES[name]:
            assert intensities is None
        else:
            np.testing.assert_array_equal(intensities, INTENSITIES)


@pytest.mark.parametrize("suffix", [".ply", ".pcd"])
@pytest.mark.parametrize("how", [{}, {"write_ascii": True}, {"compressed": True}])
def test_what_open3d_writes_is_read(tmp_path: Path, suffix: str, how: dict[str, bool]) -> None:
    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor(POINTS))
    cloud.point["intensity"] = o3d.core.Tensor(INTENSITIES[:, None])
    file = tmp_path / f"0{suffix}"
    assert o3d.t.io.write_point_cloud(str(file), cloud, **how)
    read = read_file(file)
    atol = 1e-4 if how.get("write_ascii") else 0.0  # it writes few digits
    np.testing.assert_allclose(read.points, POINTS, rtol=0, atol=atol)
    np.testing.assert_allclose(read.intensities, INTENSITIES, rtol=0, atol=atol)


def test_decompression_is_that_of_plain_python(tmp_path: Path) -> None:
    """Open3D compresses with long and overlapping repetitions."""
    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor(np.repeat(POINTS, 30, axis=0)))
    file = tmp_path / "0.pcd"
    assert o3d.t.io.write_point_cloud(str(file), cloud, compressed=True)
    np.testing.assert_array_equal(read_file(file).points, np.repeat(POINTS, 30, axis=0))
    content = file.read_bytes()
    data = np.frombuffer(bytearray(content[content.index(b"compressed\n") + 19 :]), np.uint8)
    targets = np.zeros((2, 30 * NUM * 12), np.uint8)
    for target, decompress in zip(targets, (_decompress, _decompress.py_func), strict=True):
        assert decompress(data, target) == len(target)
    np.testing.assert_array_equal(*targets)


@pytest.mark.parametrize(
    ("name", "content", "complaint"),
    [
        (
            "0.ply",
            FILES["reversed.ply"].replace(b"vertex 200", b"vertex 201"),
            "truncated: its header claims 201 points",
        ),
        ("0.ply", FILES["reversed.ply"].replace(b"vertex 200", b"vertex 20"), "damaged: its header claims 20 points"),
        ("0.ply", FILES["reversed.ply"].replace(b"float z", b"float x"), "has the field x twice"),
        ("0.ply", FILES["reversed.ply"].replace(b"float z", b"float a"), "no fields x y z, only a y x"),
        ("0.ply", FILES["reversed.ply"].replace(b"float z", b"list uchar int z"), "element vertex has lists"),
        ("0.ply", FILES["reversed.ply"].replace(b"float z", b"half z"), "unknown line 'property half z'"),
        ("0.ply", b"solid ply", "does not begin with the line ply"),
        ("0.pcd", FILES["windows.pcd"].replace(b"POINTS 200", b"POINTS 300"), "POINTS is 300, WIDTH x HEIGHT 200"),
        ("0.pcd", FILES["windows.pcd"].replace(b"TYPE F", b"TYPE Q"), "field x has the unknown type Q of 4 bytes"),
        ("0.pcd", FILES["windows.pcd"].replace(b"DATA binary", b"DATA morse"), "DATA 'morse', not ascii, binary"),
        ("0.pcd", _pcd(FLOATS, b"", size="WIDTH 0\nHEIGHT 1\nPOINTS 0\n"), "it has no points"),
        ("0.npy", b"PK\x03\x04", "not a .npy file"),
    ],
)
def test_what_cannot_be_read_is_named_with_the_reason(
    tmp_path: Path, name: str, content: bytes, complaint: str
) -> None:
    file = tmp_path / name
    file.write_bytes(content)
    with pytest.raises(BadScan, match=f"{name}: .*{complaint}"):
        read_file(file)


def test_a_cut_scan_is_skipped_and_the_others_are_mapped(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    for number in range(3):
        (tmp_path / f"{number}.ply").write_bytes(FILES["reversed.ply"])
    os.truncate(tmp_path / "1.ply", 1500)
    assert [scan.index for scan in open_dataset(tmp_path)] == [0, 2]
    assert "1.ply: it is truncated: its header claims 200 points, 2400 bytes, but" in caplog.text


@pytest.mark.parametrize("suffix", [".bin", ".ply", ".pcd", ".npy"])
def test_a_file_too_large_for_a_scan_is_refused_unread(tmp_path: Path, suffix: str) -> None:
    file = tmp_path / f"0{suffix}"
    file.touch()
    os.truncate(file, 20 * 2**30)
    with pytest.raises(BadScan, match="21474836480 bytes are too many for one scan"):
        read_file(file)


def test_what_is_no_file_does_not_block(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "0.bin")
    with pytest.raises(BadScan, match="not a regular file"):
        read_file(tmp_path / "0.bin")


def test_hidden_files_of_other_systems_are_no_scans(tmp_path: Path) -> None:
    for number in range(2):
        np.ones((10, 4), np.float32).tofile(tmp_path / f"{number}.bin")
        (tmp_path / f"._{number}.bin").write_bytes(RNG.bytes(4096))
    assert len(open_dataset(tmp_path)) == 2


def test_npy_files_are_scans_unless_there_are_others(tmp_path: Path) -> None:
    np.save(tmp_path / "0.npy", np.ones((5, 3)))
    assert len(open_dataset(tmp_path)[0].points) == 5
    np.ones((10, 4), np.float32).tofile(tmp_path / "1.bin")
    assert [len(scan.points) for scan in open_dataset(tmp_path)] == [10]


@pytest.mark.parametrize("num", [3, 4])
def test_a_transposed_npy_is_refused_with_the_remedy(tmp_path: Path, num: int) -> None:
    np.save(tmp_path / "0.npy", np.ones((num, 500)))
    with pytest.raises(
        BadScan, match=rf"its shape \({num}, 500\) is transposed; .* numpy\.save\('NAME\.npy', array\.T\)"
    ):
        read_file(tmp_path / "0.npy")
    np.save(tmp_path / "0.npy", np.ones((num, 9)))
    assert len(read_file(tmp_path / "0.npy").points) == num


def test_a_point_beyond_all_numbers_is_no_point(tmp_path: Path) -> None:
    for wild in (1e18, 3e38, np.inf, 1e300):
        np.save(tmp_path / "0.npy", np.array([[1.0, 2.0, 3.0], [wild, 3.0, 1.0]]))
        points = open_dataset(tmp_path)[0].points
        assert np.isfinite(points).all()
        assert len(points) == (2 if wild == 1e18 else 1)


def _column(text: str, num_rows: int) -> Columns:
    return text_columns(b"x " + text.encode(), 2, num_rows, [Field("x", np.dtype("<f8"))], is_last=True)


@pytest.mark.parametrize("form", ["{!r}", "{:g}", "{:.3f}", "{:e}", "{:.9g}", "{:+.0f}."])
def test_numbers_in_text_are_those_of_python(form: str) -> None:
    rng = np.random.default_rng(3)
    values = rng.uniform(-1, 1, 2000) * 10.0 ** rng.integers(-25, 25, 2000)
    words = [form.format(value) for value in values.tolist()]
    words += ["nan", "inf", "-inf", "-0", ".5", "00012", "9007199254740993", "1e400", "1e-400", "1E+2"]
    np.testing.assert_array_equal(_column("\r\n ".join(words) + " ", len(words))["x"], [float(word) for word in words])


@pytest.mark.parametrize("word", ["1e", "1e+", "-", ".", "1.2.3", "1-2", "e5", "0x1", "1_0", "1e--5", "1e5-", "\0"])
def test_text_that_is_no_number_is_refused(word: str) -> None:
    with pytest.raises(ValueError, match=r"number|convert"):
        _column(f"1 {word} 2\n", 3)


@pytest.mark.parametrize("last", [b"9", b"9.125"])
def test_a_text_without_a_last_line_end_may_be_cut(tmp_path: Path, last: bytes) -> None:
    fields = [Field(name, np.dtype("f4"), 1) for name in "xyz"]
    assert len(text_columns(b"1 2 3\n4 5 6\n7 8 9\n", 0, 3, fields, is_last=True)["x"]) == 3
    with pytest.raises(ValueError, match="its last line has no end, so its last number may be cut"):
        text_columns(b"1 2 3\n4 5 6\n7 8 " + last, 0, 3, fields, is_last=True)
