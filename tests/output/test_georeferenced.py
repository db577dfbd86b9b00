"""A run on the globe: its files, and maps that other programs place where the fixes are."""

import csv
import errno
import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree as Xml

import laspy
import matplotlib
import numpy as np
import pytest
import rasterio
from helpers.commands import run
from helpers.finished_run import MadeRun, make_run
from helpers.gnss_drive import ORIGIN, T_ENU_MAP, write_fixes, write_graph
from helpers.gnss_drive import motions as chain_of
from helpers.sessions import write_day
from helpers.terminal import in_terminal
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from pyproj import Transformer

from segslam.core import geometry
from segslam.core.types import Motion, MotionState, Points, SegslamError, WorkFailed
from segslam.gnss import Origin, enu_from_geodetic, geodetic_from_enu
from segslam.gnss.geodesy import utm
from segslam.graph.g2o import G2oGraph, write_g2o
from segslam.graph.noise import UNKNOWN_MOTION
from segslam.output import georeferenced
from segslam.output.export import export, track
from segslam.output.finished import read_run
from segslam.output.folder import ADJUSTED_GRAPH, write_localised
from segslam.output.georeferenced import Globe, georeference, read_globe, recorded_fixes, take_over
from segslam.output.log import read_log, schema
from segslam.output.log.locations import write_locations
from segslam.output.map.picture import _affine
from segslam.output.report.figures import STYLE, draw_fixes
from segslam.scans import open_dataset

KML = "{http://www.opengis.net/kml/2.2}"
GPX = "{http://www.topografix.com/GPX/1/1}"
SAME_DEG = 1e-7


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> MadeRun:
    root = tmp_path_factory.mktemp("globe é")
    found = make_run(root / "run")
    write_graph(found.folder)
    trajectory = found.result.trajectory
    write_fixes(root / "fixes.csv", trajectory.stamp_ns, trajectory.T_world_lidar)
    assert run("georeference", found.folder, "--gnss", root / "fixes.csv", "--quiet") == 0
    return found


def test_fixes_outside_a_drive_are_not_passed_on_to_a_merged_run(made: MadeRun, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(made.folder, tmp_path / "run"))
    known, _ = recorded_fixes(folder)
    *rows, last = (folder / "gnss.csv").read_text().splitlines()
    assert last.endswith(",1,")
    (folder / "gnss.csv").write_text("\n".join([*rows, last.removesuffix("1,") + "0,outside_run"]) + "\n")
    fixes, _ = recorded_fixes(folder)
    assert fixes == known[:-1]


@pytest.mark.slow
def test_quiet_prints_nothing_and_json_one_value(made: MadeRun, capfd: pytest.CaptureFixture[str]) -> None:
    fixes = made.folder.parent / "fixes.csv"
    assert run("georeference", made.folder, "--gnss", fixes, "--quiet") == 0
    assert capfd.readouterr() == ("", "")
    assert run("georeference", made.folder, "--gnss", fixes, "--json") == 0
    assert json.loads(capfd.readouterr().out)["epsg"] == 32632


def _enu(rows: Points) -> Points:
    """Of longitude, latitude, height, in the frame of the fixes."""
    return enu_from_geodetic(rows[:, [1, 0, 2]], ORIGIN)


def test_the_files_say_where_every_scan_is(made: MadeRun) -> None:
    values = json.loads((made.folder / "georeference.json").read_text())
    assert values["epsg"] == 32632
    assert values["num_fixes_kept"] > 100
    assert len(values["T_enu_map"]) == 16
    assert (values["clock_offset_s"], values["clock_offset_sigma_s"]) == (0.0, None), (
        "not measured, so not known to 0 s"
    )
    assert values["lever_arm_sigma_m"] == [None, None]
    metrics = json.loads((made.folder / "metrics.json").read_text())
    assert metrics["gnss_kept"] + metrics["gnss_dropped"] == values["num_fixes"]
    trajectory = made.result.trajectory
    with (made.folder / "poses_geodetic.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    places = np.array([[float(row[name]) for name in ("longitude", "latitude", "height")] for row in rows])
    assert [round(1e9 * float(row["seconds"])) for row in rows[:3]] == trajectory.stamp_ns[:3].tolist()
    true_enu_m = geometry.apply(T_ENU_MAP, trajectory.T_world_lidar[:, :3, 3])
    np.testing.assert_allclose(_enu(places), true_enu_m, atol=0.2)
    heading_deg = float(rows[0]["heading"])
    ahead = (T_ENU_MAP @ trajectory.T_world_lidar[0])[:2, 0]
    assert abs((heading_deg - np.degrees(np.arctan2(*ahead)) + 180.0) % 360.0 - 180.0) < 0.5
    with (made.folder / "gnss.csv").open() as stream:
        fixes = list(csv.DictReader(stream))
    assert len(fixes) == len(trajectory)
    assert {row["reason"] for row in fixes if row["kept"] == "1"} == {""}


def _num_messages(folder: Path) -> int:
    with (folder / "log.mcap").open("rb") as stream:
        return sum(1 for _ in make_reader(stream).iter_messages())


@pytest.mark.slow
def test_the_log_shows_fixes_and_positions_on_a_map(made: MadeRun, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(made.folder, tmp_path / "run"))
    before = [(step.scan_index, step.stamp_ns) for step in read_log(folder / "log.mcap").steps()]
    size, num_messages = (folder / "log.mcap").stat().st_size, _num_messages(folder)
    assert run("georeference", folder, "--gnss", made.folder.parent / "fixes.csv", "--quiet") == 0
    new_size = (folder / "log.mcap").stat().st_size
    assert new_size == pytest.approx(size, rel=1e-3), "the positions of before are replaced"  # digits may differ
    assert _num_messages(folder) == num_messages
    trajectory = made.result.trajectory
    with (folder / "log.mcap").open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        summary = reader.get_summary()
        shown = {
            topic: [message for *_, message in reader.iter_decoded_messages(topics=[topic])]
            for topic in (schema.FIXES, schema.POSITIONS)
        }
        assert summary is not None
        assert summary.statistics is not None
        assert summary.statistics.message_count == sum(1 for _ in reader.iter_messages())
    assert {len(messages) for messages in shown.values()} == {len(trajectory)}
    for messages, allowed_m in zip(shown.values(), (0.3, 0.2), strict=True):
        assert [message.timestamp.ToNanoseconds() for message in messages[:3]] == trajectory.stamp_ns[:3].tolist()
        places = np.array([(message.longitude, message.latitude, message.altitude) for message in messages])
        np.testing.assert_allclose(
            _enu(places), geometry.apply(T_ENU_MAP, trajectory.T_world_lidar[:, :3, 3]), atol=allowed_m
        )
    log = read_log(folder / "log.mcap")
    assert [(step.scan_index, step.stamp_ns) for step in log.steps()] == before
    found = log.result()
    assert found is not None
    np.testing.assert_array_equal(found[1].T_world_lidar, trajectory.T_world_lidar)


def test_a_log_without_index_is_named(tmp_path: Path) -> None:
    log = tmp_path / "log.mcap"
    log.write_bytes(b"\x89MCAP0\r\n")
    with pytest.raises(SegslamError, match="has no index"):
        write_locations(log, {})


def test_a_place_has_the_same_coordinates_in_all_files(made: MadeRun, tmp_path: Path) -> None:
    names = ("map.laz", "map.tif", "track.geojson", "track.kml", "track.gpx", "map_projector_info.yaml", "map.ply")
    assert run("export", made.folder, *(tmp_path / name for name in names), "--quiet") == 0
    with (made.folder / "poses_geodetic.csv").open() as stream:
        first = next(csv.DictReader(stream))
    longitude, latitude = float(first["longitude"]), float(first["latitude"])
    line = json.loads((tmp_path / "track.geojson").read_text())["features"][0]["geometry"]["coordinates"]
    in_kml = Xml.parse(tmp_path / "track.kml").findtext(f".//{KML}coordinates", "").split()[0].split(",")
    in_gpx = Xml.parse(tmp_path / "track.gpx").find(f".//{GPX}trkpt")
    assert in_gpx is not None
    for found in (line[0][:2], in_kml[:2], (in_gpx.get("lon"), in_gpx.get("lat"))):
        np.testing.assert_allclose(np.array(found, float), [longitude, latitude], atol=SAME_DEG)
    globe = read_globe(made.folder)
    assert globe is not None
    cloud = laspy.read(tmp_path / "map.laz")
    crs = cloud.header.parse_crs()
    assert crs.to_epsg() == 32632
    back = Transformer.from_crs(crs, 4979, always_xy=True)
    of_cloud = np.column_stack(back.transform(cloud.x, cloud.y, cloud.z))
    local = _plain_points(tmp_path / "map.ply")
    np.testing.assert_allclose(enu_from_geodetic(of_cloud[:, [1, 0, 2]], globe.origin), local, atol=0.002)
    with rasterio.open(tmp_path / "map.tif") as image:
        assert image.crs.to_epsg() == 32632
        rows, columns = rasterio.transform.rowcol(image.transform, cloud.x, cloud.y)
        colors = image.read()[:, np.clip(rows, 0, image.height - 1), np.clip(columns, 0, image.width - 1)]
    assert (colors != 255).any(axis=0).mean() > 0.9, "points are where the image is not blank"


def _opened(file: Path, layer: str | None = None) -> Points:
    """(n, 2 or 3) longitude, latitude and height of the lines of a file, as GDAL reads them."""
    gdal = pytest.importorskip("pyogrio", reason="pip install '.[dev]'").raw
    _, _, (geometry, *_), _ = gdal.read(file, layer=layer)
    return _coordinates(memoryview(geometry))


def _coordinates(wkb: memoryview) -> Points:
    """The points of a LineString or MultiLineString in well-known binary, with the dimensions of its type."""
    kind, number = np.frombuffer(wkb[1:9], "<u4").tolist()
    dimensions = 3 if kind >> 31 or (kind & 0xFFFF) // 1000 == 1 else 2
    if (kind & 0xFFFF) % 1000 == 2:
        return np.frombuffer(wkb[9 : 9 + 8 * dimensions * number], "<f8").reshape(number, dimensions)
    parts, start = [], 9
    for _ in range(number):
        parts.append(_coordinates(wkb[start:]))
        start += 9 + parts[-1].nbytes
    return np.vstack(parts)


def test_tracks_open_in_gdal_where_the_scans_are(made: MadeRun, tmp_path: Path) -> None:
    rows = _geodetic(made.folder)
    for name, layer in (("track.geojson", None), ("track.kml", None), ("track.gpx", "tracks")):
        assert run("export", made.folder, tmp_path / name, "--quiet") == 0
        np.testing.assert_allclose(_opened(tmp_path / name, layer)[:, :2], rows[:, :2], rtol=0, atol=SAME_DEG)


def test_a_track_across_the_date_line_is_cut_there(tmp_path: Path) -> None:
    """RFC 7946: two parts; otherwise a map shows a line round the Earth."""
    east_m = np.arange(-40.0, 41.0, 10.0)
    poses = np.tile(np.eye(4), (len(east_m), 1, 1))
    poses[:, 0, 3] = east_m
    globe = Globe(Origin(17.0, 179.99999, 5.0), poses)
    file = tmp_path / "track.geojson"
    file.write_bytes(track(file, globe, np.arange(len(east_m)), name="a"))
    parts = json.loads(file.read_text())["features"][0]["geometry"]["coordinates"]
    assert [len(part) for part in parts] == [5, 4]
    assert parts[0][-1][0] > 179.0
    assert parts[1][0][0] < -179.0
    opened = _opened(file)
    np.testing.assert_allclose(enu_from_geodetic(opened[:, [1, 0, 2]], globe.origin)[:, 0], east_m, atol=0.001)


def test_a_track_has_no_line_between_two_drives(tmp_path: Path) -> None:
    poses = np.tile(np.eye(4), (6, 1, 1))
    poses[:, 0, 3] = 10.0 * np.arange(6)
    files = [tmp_path / name for name in ("track.geojson", "track.kml", "track.gpx")]
    for file in files:
        file.write_bytes(track(file, Globe(Origin(17.0, 8.0, 5.0), poses), np.arange(6), name="a", cuts=[2, 5]))
    parts = json.loads(files[0].read_text())["features"][0]["geometry"]["coordinates"]
    assert [len(part) for part in parts] == [2, 3, 2], "a line has two ends, also of one scan"
    lines = Xml.parse(files[1]).findall(f".//{KML}MultiGeometry/{KML}LineString/{KML}coordinates")
    assert [len((line.text or "").split()) for line in lines] == [2, 3, 2]
    assert [len(segment) for segment in Xml.parse(files[2]).findall(f".//{GPX}trkseg")] == [2, 3, 1]


def test_a_pixel_of_the_geotiff_is_where_the_point_is() -> None:
    """Up to the edge of a UTM zone, 500 m from the origin."""
    for longitude in (8.39, 11.9999, 179.9999):
        epsg, projected = utm(Origin(48.98, longitude, 115.0))
        window, pixels = (-500.0, 500.0, -300.0, 300.0), np.array([[0.0, 0.0], [321.0, 55.0], [1000.0, 600.0]])
        affine = _affine(projected, window, 600, 1000, 0.0)
        east_north = np.column_stack([-500.0 + pixels[:, 0], 300.0 - pixels[:, 1], np.zeros(3)])
        expected = geodetic_from_enu(east_north, Origin(48.98, longitude, 115.0))
        there = np.column_stack([pixels, np.ones(3)]) @ affine.T
        back = Transformer.from_crs(epsg, 4979, always_xy=True).transform(*there.T)
        off_deg = (np.column_stack(back) - expected[:, [1, 0]] + 180.0) % 360.0 - 180.0
        assert np.abs(off_deg).max() < SAME_DEG


def _plain_points(file: Path) -> Points:
    """Positions of the PLY file that `export` writes."""
    import open3d

    return np.asarray(open3d.io.read_point_cloud(str(file)).points)


@pytest.mark.long
def test_a_run_without_fixes_has_no_such_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plain = make_run(tmp_path / "run").folder
    for name in ("map.tif", "track.geojson", "map_projector_info.yaml"):
        assert run("export", plain, tmp_path / name) == 2
        assert "segslam georeference" in capsys.readouterr().err
        assert not (tmp_path / name).exists()
    write_fixes(tmp_path / "fixes.csv", np.arange(3), np.tile(np.eye(4), (3, 1, 1)))
    assert run("georeference", plain, "--gnss", tmp_path / "fixes.csv") == 2
    assert "adjusted.g2o: missing" in capsys.readouterr().err
    status, printed = in_terminal("-m", "segslam", "georeference", str(plain))
    assert status == 2
    assert "give the position fixes" in printed
    assert "None" not in printed
    assert run("georeference", plain, "--gnss", tmp_path / "fixes.csv", "--gnss-use", "bend") == 2
    assert "known: fuse, align" in capsys.readouterr().err
    assert not (plain / "georeference.json").exists()


def test_the_report_shows_the_fixes(made: MadeRun, tmp_path: Path) -> None:
    with matplotlib.rc_context(STYLE):
        drawn = draw_fixes(made.folder)
    assert drawn is not None
    assert "residual (m)" in drawn
    assert re.search(r">kept: 1\d\d<", drawn)
    assert draw_fixes(tmp_path) is None


@pytest.mark.parametrize("content", ["stamp_ns,kept\n1,1\n", "stamp_ns,residual_east_m\n1,far\n", b"\xff\xfe\x00"])
def test_a_damaged_file_of_fixes_is_named_by_the_report(made: MadeRun, tmp_path: Path, content: str | bytes) -> None:
    folder = shutil.copytree(made.folder, tmp_path / "run")
    (folder / "gnss.csv").write_bytes(content.encode() if isinstance(content, str) else content)
    with pytest.raises(SegslamError, match=r"gnss\.csv: damaged .*; run `segslam georeference` again"):
        draw_fixes(folder)


@pytest.mark.long
@pytest.mark.usefixtures("short_runs")
def test_map_places_a_run_before_its_maps_are_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data, out = write_day(tmp_path / "monday", day=0, first=0, num_scans=22), tmp_path / "run"
    reference = open_dataset(data).reference
    assert reference is not None
    write_fixes(tmp_path / "fixes.csv", reference.stamp_ns, reference.T_world_lidar)
    options = ("--out", out, "--set", "adjustment.max_minutes=0", "--map-file", "map.laz")
    assert run("map", data, *options, "--gnss", tmp_path / "none.csv") == 2
    assert "none.csv: no such file" in capsys.readouterr().err
    assert not out.exists(), "before anything is mapped"
    assert run("map", data, *options, "--gnss", tmp_path / "fixes.csv") == 0
    assert "map placed: heading known to" in capsys.readouterr().err
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["gnss_kept"] > 15
    assert metrics["num_map_points"] > 0
    assert laspy.read(out / "map.laz").header.parse_crs().to_epsg() == 32632
    off_m = geometry.apply(T_ENU_MAP, reference.T_world_lidar[:, :3, 3]) - _enu(_geodetic(out))
    assert np.hypot(*off_m[:, :2].T).max() < 0.3


@pytest.mark.long
@pytest.mark.usefixtures("short_runs")
def test_fixes_that_place_nothing_leave_the_maps_and_others_place_the_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data, out = write_day(tmp_path / "monday", day=0, first=0, num_scans=22), tmp_path / "run"
    reference = open_dataset(data).reference
    assert reference is not None
    write_fixes(tmp_path / "fixes.csv", reference.stamp_ns, reference.T_world_lidar)
    write_fixes(tmp_path / "few.csv", reference.stamp_ns[:2], reference.T_world_lidar[:2])
    options = ("--out", out, "--set", "adjustment.max_minutes=0", "--map-file", "map.ply")
    assert run("map", data, *options, "--gnss", tmp_path / "few.csv") == 2
    assert "2 usable fixes are within the drive" in capsys.readouterr().err
    assert (out / "map.ply").is_file()
    assert not (out / "georeference.json").exists()
    assert run("map", data, *options, "--resume", "--gnss", tmp_path / "fixes.csv") == 0
    assert "map placed: heading known to" in capsys.readouterr().err
    assert read_globe(out) is not None


def test_only_localised_scans_are_in_a_track_and_in_a_map(made: MadeRun, tmp_path: Path) -> None:
    copy = tmp_path / "run"
    shutil.copytree(made.folder, copy)
    trajectory = made.result.trajectory
    from_map_m = np.where(np.arange(len(trajectory)) < 40, 3.0, np.inf)
    write_localised(copy, trajectory, from_map_m, from_map_m < 20.0)
    assert run("export", copy, copy / "a.gpx", "--quiet") == 0
    assert (copy / "a.gpx").read_text().count("<trkpt") == 40
    of_all = export(made.folder, [tmp_path / "all.ply"])["num_map_points"]
    assert 0 < export(copy, [copy / "a.ply"])["num_map_points"] < 0.8 * of_all
    write_localised(copy, trajectory, np.full(len(trajectory), np.inf), np.zeros(len(trajectory), bool))
    assert not take_over(copy, made.folder), "no scan was localised"
    with pytest.raises(SegslamError, match="no keyframe of known pose has a static point"):
        export(copy, [copy / "b.ply"])


def test_scans_before_a_break_do_not_follow_the_keyframe_after_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The fixes show that the motion across the break is 3 m longer."""
    made = make_run(tmp_path / "run")
    finished, first = read_run(made.folder), 62  # a keyframe
    trajectory, rows = finished.result.trajectory, finished.result.keyframe_rows
    motions = [Motion(MotionState.BROKEN if row == first else MotionState.CONFIRMED) for row in range(len(trajectory))]
    broken = replace(finished, result=replace(finished.result, motions=tuple(motions)))
    monkeypatch.setattr(georeferenced, "read_run", lambda _: broken)
    T_map_keyframe = trajectory.T_world_lidar[rows]
    edges = chain_of(T_map_keyframe)
    before = int(np.searchsorted(rows, first)) - 1
    edges[before] = replace(edges[before], information=UNKNOWN_MOTION)
    write_g2o(made.folder / ADJUSTED_GRAPH, G2oGraph(dict(enumerate(T_map_keyframe)), edges))
    T_true = trajectory.T_world_lidar.copy()
    T_true[first:, 0, 3] += 3.0
    write_fixes(tmp_path / "fixes.csv", trajectory.stamp_ns, T_true, sigma_m=0.5)
    georeference(made.folder, tmp_path / "fixes.csv")
    off_m = _enu(_geodetic(made.folder)) - geometry.apply(T_ENU_MAP, T_true[:, :3, 3])
    assert np.hypot(*off_m[:, :2].T).max() < 0.5


def test_a_failure_leaves_no_poses_with_the_origin_of_an_earlier_place(
    made: MadeRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    folder = Path(shutil.copytree(made.folder, tmp_path / "run"))
    trajectory = made.result.trajectory
    write_fixes(tmp_path / "later.csv", trajectory.stamp_ns[30:], trajectory.T_world_lidar[30:])
    monkeypatch.setattr(georeferenced, "write_locations", full)
    with pytest.raises(WorkFailed, match="No space left on device"):
        georeference(folder, tmp_path / "later.csv")
    assert read_globe(folder) is None


def test_a_place_is_refused_with_the_reason(made: MadeRun, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    fixes = made.folder.parent / "fixes.csv"
    assert run("georeference", made.folder, "--gnss", fixes, "--gnss-offset", "nan") == 2
    assert "--gnss-offset nan: not a difference of clocks" in capsys.readouterr().err
    with pytest.raises(SegslamError, match="offset_s=nan; give a difference of clocks in seconds"):
        georeference(made.folder, fixes, offset_s=float("nan"))
    with pytest.raises(SegslamError, match="use 'bend': unknown; known: align, fuse"):
        georeference(made.folder, fixes, use="bend")


def _geodetic(folder: Path) -> Points:
    """(n, 3) longitude, latitude, height of a run."""
    rows = np.loadtxt(folder / "poses_geodetic.csv", delimiter=",", skiprows=1)
    return rows[:, [2, 1, 3]]
