"""Two simulated sessions on two days: merged into one run, and localised one in the map of the other."""

import hashlib
import json
import re
import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from helpers.commands import run
from helpers.gnss_drive import ORIGIN, T_ENU_MAP, write_fixes
from helpers.sessions import write_day
from helpers.terminal import in_terminal
from matplotlib.figure import Figure

import segslam
from segslam.core import geometry
from segslam.core.config import Config, load_config
from segslam.core.evaluation import align_positions
from segslam.core.types import LoopClosure, MotionState, Trajectory
from segslam.gnss import enu_from_geodetic
from segslam.output.finished import FinishedRun, Part, read_run
from segslam.output.log import read_log
from segslam.output.map import picture
from segslam.output.report import comparison, figures
from segslam.output.report.loops import top_view
from segslam.run.sessions import merge
from segslam.run.sessions.merge import arranged
from segslam.run.sessions.recorded import SessionPose, figures_of, read_sessions
from segslam.slam.loop_edits import LoopEdits
from segslam.slam.slam import Slam

pytestmark = [pytest.mark.long, pytest.mark.usefixtures("short_runs")]

UNADJUSTED = load_config(None, ["adjustment.max_minutes=0"])
"""Of a single day; both are adjusted together."""


@dataclass(frozen=True)
class Days:
    monday: FinishedRun
    friday: FinishedRun
    friday_scans: Path


@pytest.fixture(scope="module")
def days(tmp_path_factory: pytest.TempPathFactory) -> Days:
    """Runs of two drives that share two thirds of their ways."""
    root = tmp_path_factory.mktemp("days")
    scans = [
        write_day(root / name, day=day, first=first, num_scans=22)
        for name, day, first in (("monday", 0, 0), ("friday", 1, 6))
    ]
    runs = [segslam.map_folder(folder, root / f"{folder.name}_run", config=UNADJUSTED) for folder in scans]
    return Days(runs[0], runs[1], scans[1])


@pytest.fixture(scope="module")
def merged(days: Days, tmp_path_factory: pytest.TempPathFactory) -> FinishedRun:
    out = tmp_path_factory.mktemp("merged") / "run"
    return segslam.merge([days.monday.folder, days.friday.folder], out, config=Config(), same_reference=True)


def _errors(estimate: Trajectory, truth: Trajectory, T_true_world: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance and angle (degrees) of each scan's pose from the true one, the map's frame given."""
    rows = np.searchsorted(truth.scan_index, estimate.scan_index)
    off = np.linalg.inv(truth.T_world_lidar[rows]) @ T_true_world @ estimate.T_world_lidar
    cosines = (np.trace(off[:, :3, :3], axis1=1, axis2=2) - 1) / 2
    return np.linalg.norm(off[:, :3, 3], axis=1), np.degrees(np.arccos(np.clip(cosines, -1, 1)))


def _true_world(run: FinishedRun) -> np.ndarray:
    assert run.reference is not None
    own, truth = run.result.trajectory, run.reference
    rows = np.searchsorted(truth.scan_index, own.scan_index)
    return align_positions(own.T_world_lidar[:, :3, 3], truth.T_world_lidar[rows, :3, 3])


def test_two_days_become_one_frame(days: Days, merged: FinishedRun) -> None:
    """The frame of each day, fitted to its scans, is the same; nearly all scans are correct in that of the first."""
    assert merged.reference is not None
    whole, first = merged.result.trajectory, len(days.monday.result.trajectory)
    positions = whole.T_world_lidar[:, :3, 3]
    true = merged.reference.T_world_lidar[np.searchsorted(merged.reference.scan_index, whole.scan_index), :3, 3]
    monday, friday = (align_positions(positions[day], true[day]) for day in (slice(first), slice(first, None)))
    apart_m = np.linalg.norm(geometry.apply(monday, positions) - geometry.apply(friday, positions), axis=1)
    assert apart_m.max() < 0.15
    assert np.degrees(geometry.angle(geometry.inverse(monday) @ friday)) < 0.5
    distance_m, angle_deg = _errors(whole, merged.reference, monday)
    assert np.median(distance_m) < 0.1
    assert distance_m.max() < 0.3
    assert angle_deg.max() < 1.0
    assert merged.metrics["num_sessions"] == 2
    lengths_m = [day.metrics["length_m"] for day in (days.monday, days.friday)]
    assert merged.metrics["length_m"] == pytest.approx(sum(lengths_m), rel=0.02), "without the way between them"
    assert merged.metrics["num_loops_between"] >= 3
    assert merged.metrics["num_loops_false"] == 0
    assert merged.metrics["num_motions_broken"] == 0


def test_the_way_between_the_sessions_of_a_run_does_not_count_if_it_is_merged_again(merged: FinishedRun) -> None:
    as_one = Part(first_keyframe=0, num_scans=len(merged.result.trajectory))
    assert figures_of([as_one], merged.result)["length_m"] == pytest.approx(merged.metrics["length_m"])


def test_pictures_of_a_merged_run_do_not_show_the_way_between_its_drives(
    merged: FinishedRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[np.ndarray] = []
    monkeypatch.setattr(picture, "drawn_map", lambda *_, path_m, **__: drawn.append(path_m) or b"")
    segslam.export(merged.folder, tmp_path / "map.png")
    shown: list[Figure] = [merged.result.plot(merged.reference)]
    monkeypatch.setattr(figures, "svg", lambda figure, _: shown.append(figure) or "")
    for draw in (figures.draw_paths, figures.draw_loops, figures.draw_errors):
        draw(merged)
    long = [line for figure in shown for axes in figure.axes for line in axes.lines if len(line.get_xdata()) > 40]
    drawn += [np.column_stack([line.get_xdata(), line.get_ydata()]) for line in long]
    compared: list[Figure] = []
    saved = Figure.savefig
    monkeypatch.setattr(Figure, "savefig", lambda *args, **more: compared.append(args[0]) or saved(*args, **more))
    comparison.draw_runs(tmp_path / "compared.png", {"merged": merged})
    assert run("eval", merged.folder, "--plot", tmp_path / "scored.png") == 0
    drawn += [line.get_xydata() for figure in compared for axes in figure.axes for line in axes.lines]
    page = top_view(merged, lambda _: (np.zeros((1, 3)), np.zeros(1, np.uint8)))
    data = json.loads(re.findall(r'id="topview-data">(.*?)</script>', page, re.DOTALL)[0])
    drawn += [np.array([path["x"], path["y"]], float).T for path in data["paths"]]
    assert {len(values) for values in data["values"].values()} == {len(data["paths"][-1]["x"])}
    assert len(drawn) >= 19
    assert {int(np.isnan(line).any(axis=1).sum()) for line in drawn} == {1}


def test_scans_and_stamps_of_the_second_session_follow_the_first(days: Days, merged: FinishedRun) -> None:
    whole = merged.result.trajectory
    first, second = days.monday.result.trajectory, days.friday.result.trajectory
    assert len(whole) == len(first) + len(second)
    assert (np.diff(whole.stamp_ns) > 0).all()
    np.testing.assert_array_equal(np.diff(whole.stamp_ns[len(first) :]), np.diff(second.stamp_ns))
    np.testing.assert_array_equal(whole.scan_index[len(first) :], second.scan_index + first.scan_index[-1] + 1)
    [_, shift] = json.loads(merged.options["sessions"])
    assert shift["stamp_shift_ns"] == whole.stamp_ns[-1] - second.stamp_ns[-1]
    states = [motion.state for motion in merged.result.motions]
    assert states.index(MotionState.BEGUN) == len(first)


def test_true_poses_after_the_last_scan_of_a_session_are_not_those_of_the_next(days: Days) -> None:
    monday, friday = read_sessions([days.monday.folder, days.friday.folder])
    assert monday.run.reference is not None
    truth = monday.run.reference
    longer = Trajectory(
        np.append(truth.scan_index, np.arange(22, 27)),
        np.append(truth.stamp_ns, truth.stamp_ns[-1] + 100_000_000 * np.arange(1, 6)),
        np.append(truth.T_world_lidar, truth.T_world_lidar[:5], axis=0),
    )
    stopped = replace(monday, run=replace(monday.run, reference=longer))
    poses = [None, SessionPose(0, np.eye(4), ())]
    whole, early = (arranged([one, friday], poses, same_reference=True).reference for one in (monday, stopped))
    assert whole is not None
    assert early is not None
    np.testing.assert_array_equal(early.scan_index, whole.scan_index)
    np.testing.assert_array_equal(early.T_world_lidar, whole.T_world_lidar)


def test_loops_that_a_person_forbade_in_a_session_stay_forbidden(
    days: Days, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monday, friday = read_sessions([days.monday.folder, days.friday.folder])
    edited = LoopEdits(forbidden=frozenset({(9, 1)}), added=frozenset({(8, 2)}))
    options = {**friday.run.options, "edits": edited.to_json()}
    friday = replace(friday, run=replace(friday.run, options=options))
    given: list[LoopEdits] = []
    monkeypatch.setattr(merge, "Slam", lambda config, edits, **more: given.append(edits) or Slam(config, **more))
    first = len(monday.keyframes)
    with arranged([monday, friday], [None, SessionPose(0, np.eye(4), ())]).begun(tmp_path, Config()):
        again = LoopEdits.from_json(read_log(tmp_path).options["edits"])
    assert given == [again] == [LoopEdits(frozenset({(9 + first, 1 + first)}), frozenset({(8 + first, 2 + first)}))]


@pytest.fixture(scope="module")
def on_globe(days: Days, tmp_path_factory: pytest.TempPathFactory) -> Days:
    """The same runs, each georeferenced by its own fixes in one true frame, Friday's with its clock 2 s off."""
    root = tmp_path_factory.mktemp("on_globe")
    made = []
    for number, one in enumerate((days.monday, days.friday)):
        folder = Path(shutil.copytree(one.folder, root / one.folder.name))
        assert one.reference is not None
        late_ns = 2_000_000_000 * number
        write_fixes(root / "fixes.csv", one.reference.stamp_ns - late_ns, one.reference.T_world_lidar)
        segslam.georeference(folder, root / "fixes.csv", offset_s=1e-9 * late_ns)
        made.append(read_run(folder))
    return Days(made[0], made[1], days.friday_scans)


def _off_globe_m(folder: Path, truth: Trajectory) -> np.ndarray:
    """Horizontal errors of the scans in `poses_geodetic.csv`."""
    rows = np.loadtxt(folder / "poses_geodetic.csv", delimiter=",", skiprows=1)
    own = np.searchsorted(truth.stamp_ns, np.rint(1e9 * rows[:, 0]).astype(np.int64) - 1000)
    true_m = geometry.apply(T_ENU_MAP, truth.T_world_lidar[own, :3, 3])
    return np.hypot(*(enu_from_geodetic(rows[:, 1:4], ORIGIN) - true_m)[:, :2].T)


def test_a_merged_run_is_placed_by_the_fixes_of_all_sessions(
    on_globe: Days, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = segslam.merge([on_globe.monday.folder, on_globe.friday.folder], tmp_path / "both", same_reference=True)
    values = json.loads((made.folder / "georeference.json").read_text())
    assert values["num_fixes"] == len(made.result.trajectory)
    assert values["num_fixes_kept"] > 0.9 * values["num_fixes"]
    assert made.reference is not None
    assert _off_globe_m(made.folder, made.reference).max() < 0.4
    segslam.export(made.folder, tmp_path / "track.geojson")
    parts = json.loads((tmp_path / "track.geojson").read_text())["features"][0]["geometry"]["coordinates"]
    assert [len(part) for part in parts] == [22, 22]


@pytest.mark.slow
def test_a_run_localised_in_a_georeferenced_map_is_on_the_globe(on_globe: Days, tmp_path: Path) -> None:
    made = segslam.localise(on_globe.monday.folder, on_globe.friday_scans, tmp_path / "there", config=UNADJUSTED)
    assert on_globe.friday.reference is not None
    errors_m = _off_globe_m(made.folder, on_globe.friday.reference)
    assert len(errors_m) == made.result.localised().sum()
    assert errors_m.max() < 0.5
    assert not (made.folder / "gnss.csv").exists()
    assert run("export", made.folder, tmp_path / "track.geojson", "--quiet") == 0


@pytest.mark.slow
def test_every_command_works_in_a_terminal(days: Days, tmp_path: Path) -> None:
    monday, friday = str(days.monday.folder), str(days.friday.folder)
    first_scan = str(days.friday_scans / "sequences" / "00" / "velodyne" / "000000.bin")
    shown = ""
    for command in (
        ("locate", monday, first_scan),
        ("merge", monday, friday, "--out", str(tmp_path / "both"), "--map"),
        ("localise", monday, str(days.friday_scans), "--out", str(tmp_path / "there")),
    ):
        status, output = in_terminal("-m", "segslam", *command)
        assert status == 0, output
        assert "Traceback" not in output
        shown += output
    for title, count in (("locate", 1), ("merge", 44), ("localise", 22)):
        assert re.search(rf"{title} .*{count}/{count}", shown), title
    assert "loops between sessions: " in shown
    assert "localised in the old map: 100.0 %" in shown
    assert (tmp_path / "both" / "map.ply").is_file()


@pytest.mark.slow
def test_a_merged_log_replays_and_finds_the_second_session_again(
    days: Days, merged: FinishedRun, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("replay", merged.folder, "--out", tmp_path / "again", "--json", "--quiet") == 0
    metrics = json.loads(capsys.readouterr().out)
    assert metrics["num_scans"] == merged.metrics["num_scans"]
    assert (metrics["num_sessions"], metrics["num_loops_between"] >= 3) == (2, True)
    assert metrics["length_m"] == pytest.approx(merged.metrics["length_m"], rel=0.02)
    assert metrics["ate_m"] < 0.3
    first_id = int((days.monday.result.keyframe_rows >= 0).sum())
    steps = read_log(tmp_path / "again" / "log.mcap").steps(clouds=False)
    closures = [attempt.outcome for step in steps for attempt in step.attempts]
    assert any(isinstance(one, LoopClosure) and one.target_id < first_id <= one.source_id for one in closures)


@pytest.mark.slow
def test_a_session_in_another_town_is_refused_and_nothing_is_left(
    days: Days, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    elsewhere = segslam.map_folder(
        write_day(tmp_path / "scans", day=0, first=0, num_scans=6, seed=8), tmp_path / "elsewhere"
    )
    assert run("merge", days.monday.folder, elsewhere.folder, "--out", tmp_path / "both") == 2
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert str(elsewhere.folder) in error
    assert "not found in any other run" in error
    assert not (tmp_path / "both").exists()


def test_a_session_that_shares_too_short_a_way_is_refused_with_this_reason(days: Days, tmp_path: Path) -> None:
    scans = write_day(tmp_path / "scans", day=1, first=6, num_scans=4)
    dense = load_config(None, ["keyframes.distance_m=1"], base=UNADJUSTED)
    short = segslam.map_folder(scans, tmp_path / "short", config=dense)
    with pytest.raises(segslam.SegslamError, match=r"were found there, but all within 10 m of its drive: too short"):
        segslam.merge([days.monday.folder, short.folder], tmp_path / "both")


def test_a_new_day_is_localised_in_the_old_map_which_is_only_read(
    days: Days, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = _contents(days.monday.folder)
    out = tmp_path / "run"
    assert run("localise", days.monday.folder, days.friday_scans, "--out", out, "--json", "--quiet") == 0
    metrics = json.loads(capsys.readouterr().out)
    assert metrics["localised_percent"] == 100.0
    assert "loop_recall" not in metrics, "loops within the drive are not searched"
    assert _contents(days.monday.folder) == before
    localised = segslam.read_run(out)
    assert localised.reference is not None
    shared = localised.result.trajectory.scan_index < 16  # then the map ends
    distance_m, angle_deg = _errors(localised.result.trajectory, localised.reference, _true_world(days.monday))
    assert (distance_m[shared] < 0.3).mean() >= 0.98
    assert (angle_deg[shared] < 1.0).mean() >= 0.98
    steps = list(read_log(out / "log.mcap").steps(clouds=False))
    placed = [placement for step in steps for placement in step.placements]
    assert placed[0].is_found
    assert not placed[-1].is_found
    assert len((out / "localised.csv").read_text().splitlines()) == 1 + metrics["num_scans"]
    assert localised.result.from_map_m is not None
    (out / "localised.csv").write_text("scan,stamp_ns\n0,0\n")
    with pytest.raises(segslam.SegslamError, match=r"localised\.csv: damaged"):
        segslam.read_run(out)


def _contents(folder: Path) -> dict[str, str]:
    return {file.name: hashlib.sha256(file.read_bytes()).hexdigest() for file in sorted(folder.iterdir())}


@pytest.mark.slow
def test_missing_scans_do_not_affect_the_result(days: Days, tmp_path: Path) -> None:
    gap = write_day(tmp_path / "gap", day=1, first=0, num_scans=18, without=range(6, 12))
    run_there = segslam.localise(days.monday.folder, gap, tmp_path / "run")
    assert run_there.reference is not None
    assert run_there.metrics["localised_percent"] == 100.0
    distance_m, angle_deg = _errors(run_there.result.trajectory, run_there.reference, _true_world(days.monday))
    assert distance_m.max() < 0.3
    assert angle_deg.max() < 1.0


@pytest.mark.slow
def test_a_drive_through_another_town_is_not_localised(
    days: Days, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    elsewhere = write_day(tmp_path / "scans", day=0, first=0, num_scans=5, seed=8)
    out = ("--out", tmp_path / "run", "--map-file", "map.ply")
    assert run("localise", days.monday.folder, elsewhere, *out, "--quiet") == 1
    assert "no scan was found in the map" in capsys.readouterr().err
    assert (tmp_path / "run" / "poses_tum.txt").read_text() == ""
    rows = (tmp_path / "run" / "localised.csv").read_text().splitlines()[1:]
    assert [row.split(",")[2:] for row in rows] == 5 * [["0", ""]]
    assert not (tmp_path / "run" / "map.ply").exists()
