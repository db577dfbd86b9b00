"""Single scans in a finished run, with no guess."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers import commands
from helpers.drives import drifting, round_drive, round_sweeps, write_kitti_sequence

import segslam
from segslam.core import geometry
from segslam.core.config import load_config
from segslam.core.types import Rejected, RejectReason, SegslamError, Step
from segslam.labels import geometric_labels
from segslam.odometry.sweep import GivenOdometry
from segslam.output.log import read_log, reader
from segslam.run.locator import Locator, submaps_of
from segslam.run.sessions import session_pose
from segslam.run.sessions.localiser import Localiser
from segslam.run.sessions.merge import plan
from segslam.run.sessions.recorded import read_session
from segslam.slam.slam_result import SlamResult

NUM_MAPPED = 50
"""A round of the drive; the scans after it see it again."""


pytestmark = pytest.mark.usefixtures("short_runs")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run that mapped the first round."""
    folder = tmp_path_factory.mktemp("located")
    write_kitti_sequence(folder / "data", num_scans=NUM_MAPPED)
    config = load_config(None, ["health.check=false", "adjustment.max_minutes=0"])
    odometry = GivenOdometry(drifting(round_drive()[1], turn_deg=0.0, climb_m=0.0), config.odometry)
    segslam.map_folder(folder / "data", folder / "run", config=config, labels="geometric", odometry=odometry)
    return folder / "run"


def test_scans_of_a_second_round_are_found_under_any_yaw(run: Path) -> None:
    scans, truth = round_drive()
    locator = Locator.from_run(run)
    T_world_first = np.linalg.inv(truth.T_world_lidar[0])
    for number, yaw_deg in ((52, 0.0), (57, 130.0), (63, 250.0)):
        T_lidar_turned = geometry.transform(geometry.yaw(np.radians(yaw_deg)), np.zeros(3))
        turned = geometry.apply(geometry.inverse(T_lidar_turned), scans[number].points.astype(np.float64))
        found = locator.locate(turned)
        assert not isinstance(found, Rejected)
        apart = np.linalg.inv(T_world_first @ truth.T_world_lidar[number] @ T_lidar_turned) @ found.T_world_lidar
        assert geometry.distance(apart) < 0.5  # of which the odometry has a part: 1 cm a step
        assert geometry.angle(apart) < np.radians(2.0)


@pytest.mark.long
def test_the_settings_of_a_drive_decide_in_the_map_of_another(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """When it is merged or localised, a location is accepted by its own `verify.max_false_share`."""
    session, scan = read_session(run), round_drive()[0][52]
    config = session.run.config
    strict = config.model_copy(update={"verify": config.verify.model_copy(update={"max_false_share": 1e-12})})
    reasons = []
    for settings in (config, strict):
        step = Localiser(Locator(session), settings, labeller=geometric_labels).process(scan)
        assert step.not_placed is not None
        reasons.append(step.not_placed.reason)
    assert reasons == [RejectReason.UNCONFIRMED, RejectReason.IMPROBABLE]
    monkeypatch.setattr(session_pose, "NUM_QUERIES", 1)
    with pytest.raises(SegslamError, match=r"not found in any other run .* 0 of 1 keyframes"):
        plan([session, session], config=strict)


@pytest.mark.long
def test_a_scan_of_another_town_is_not_found(run: Path) -> None:
    locator = Locator.from_run(run)
    for sweep in round_sweeps(seed=8, only={10, 40}):
        found = locator.locate(sweep.points, sweep.labels)
        assert isinstance(found, Rejected)
        assert found.reason.value


def test_signatures_are_in_the_log_and_computed_if_it_has_none(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stored = [keyframe.place for keyframe in read_log(run / "log.mcap").keyframes()[0]]
    assert all(place is not None and len(place) == 1440 for place in stored)
    step_of = reader._step

    def older_step(*given: Any) -> Step:
        step = step_of(*given)
        return step if step.keyframe is None else replace(step, keyframe=replace(step.keyframe, place=None))

    monkeypatch.setattr(reader, "_step", older_step)
    for signature, place in zip(Locator.from_run(run).signatures, stored, strict=True):
        assert (signature.spectrum.ravel() == np.frombuffer(place or b"", np.uint8)).all()


def test_the_run_is_not_changed(run: Path) -> None:
    before = {file: file.read_bytes() for file in run.iterdir() if file.is_file()}
    Locator.from_run(run).locate(round_drive()[0][52].points)
    assert {file: file.read_bytes() for file in run.iterdir() if file.is_file()} == before


def test_a_damaged_log_is_refused_by_name(run: Path, tmp_path: Path) -> None:
    damaged = tmp_path / "damaged"
    damaged.mkdir()
    data = bytearray((run / "log.mcap").read_bytes())
    data[len(data) // 2 : len(data) // 2 + 64] = bytes(64)
    (damaged / "log.mcap").write_bytes(data)
    (damaged / "metrics.json").write_bytes((run / "metrics.json").read_bytes())
    with pytest.raises(SegslamError, match=r"log\.mcap"):
        Locator.from_run(damaged)


@pytest.mark.long
def test_the_command_prints_a_pose_a_scan_and_fails_where_it_finds_none(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scan, nothing = tmp_path / "a.npy", tmp_path / "b.npy"
    np.save(scan, round_drive()[0][55].points)
    np.save(nothing, np.random.default_rng(0).uniform(-20, 20, (5000, 3)))
    assert commands.run("locate", run, scan, nothing, "--json", "--quiet") == 0
    found, lost = json.loads(capsys.readouterr().out)
    assert found["found"]
    assert len(found["T_world_lidar"]) == 16
    assert found["reason"] is None
    assert found["overlap"] > 0.3
    assert found["inliers"] >= 3
    assert found["seconds"] > 0
    assert found["keyframe"] < NUM_MAPPED
    assert not lost["found"]
    assert lost["T_world_lidar"] is None
    assert lost["reason"]
    np.save(nothing, np.ones((30, 3)))  # so few are refused at once
    assert commands.run("locate", run / "log.mcap", nothing) == 1
    out, err = capsys.readouterr()
    assert out == ""
    assert "b.npy: not found: " in err


def test_poses_are_printed_though_another_scan_is_unreadable(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scan, bad = tmp_path / "a.npy", tmp_path / "b.bin"
    np.save(scan, round_drive()[0][55].points)
    bad.write_bytes(b"")
    assert commands.run("locate", run, bad, scan, "--quiet") == 2
    out, err = capsys.readouterr()
    assert out.startswith(f"{scan} ")
    assert len(out.split()) == 17
    assert "b.bin: not found: unreadable" in err
    assert "b.bin: has no points; copy the file again" in err
    assert "1 of 2 scans cannot be read" in err
    assert "--frames" not in err
    assert commands.run("locate", run, bad, scan, "--json", "--quiet") == 2
    assert [one["found"] for one in json.loads(capsys.readouterr().out)] == [False, True]


@pytest.mark.parametrize(
    ("arguments", "output"),
    [
        (["missing.npy"], "missing.npy: no such file"),
        (["--dataset", "nclt"], "--dataset nclt: only kitti"),
        (["--labels", "nowhere"], "nowhere/a.label: no such file or folder; --labels: give geometric"),
    ],
)
def test_bad_usage_of_the_command_is_one_line(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], output: str
) -> None:
    scan = tmp_path / "a.npy"
    np.save(scan, round_drive()[0][55].points)
    assert commands.run("locate", run, scan, *arguments) == 2
    assert output in capsys.readouterr().err


def test_a_folder_is_no_scan(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert commands.run("locate", run, tmp_path) == 2
    assert capsys.readouterr().err == (
        f"segslam: {tmp_path}: is a folder; give scan files, or use segslam localise for a folder of scans\n"
    )


def test_labels_of_unknown_numbering_are_refused_with_the_remedy(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    points = round_drive()[0][55].points
    np.save(tmp_path / "a.npy", points)
    np.zeros(len(points), "<u4").tofile(tmp_path / "a.label")
    assert commands.run("locate", run, tmp_path / "a.npy", "--labels", tmp_path) == 2
    assert "pass --encoding" in capsys.readouterr().err


def test_labels_of_another_number_are_refused(run: Path) -> None:
    points = round_drive()[0][55].points
    with pytest.raises(SegslamError, match=f"3 labels for {len(points)} points"):
        Locator.from_run(run).locate(points, np.zeros(3, np.uint8))


def test_a_folder_that_is_no_run_is_refused_by_name(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scan = tmp_path / "a.npy"
    np.save(scan, round_drive()[0][55].points)
    assert commands.run("locate", tmp_path / "nothing", scan) == 2
    assert "nothing: no such file or folder" in capsys.readouterr().err


def test_neighbours_whose_motion_is_unsure_are_not_merged(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As while the run was mapped: the information of each motion is in its log."""
    session = read_session(run)
    informations = [None, None, 1e-2 * np.eye(6), None, None, None]
    monkeypatch.setattr(SlamResult, "keyframe_informations", lambda result: informations)
    submaps = submaps_of(replace(session, keyframes=session.keyframes[:6]), load_config(None, []))
    assert set(submaps._neighbours(1, 5)) == {0}
    assert 1 not in set(submaps._neighbours(2, 5))
