"""A fleet of two days in one place, a stranger and a damaged recording: joined, gone on with, and on a cluster."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.commands import run
from helpers.gnss_drive import ORIGIN, write_fixes
from helpers.recorded_drive import TOPIC, clouds, write_mcap
from helpers.sessions import write_day
from helpers.terminal import in_terminal

import segslam.run.fleets.orchestrate
from segslam.core.pose_files import read_poses
from segslam.core.types import SegslamError, Step
from segslam.gnss import enu_from_geodetic
from segslam.output.finished import read_run
from segslam.run.fleets import steps, workers
from segslam.run.fleets.drives import Drive, read_drives
from segslam.run.fleets.orchestrate import FILE, FleetResult, fleet
from segslam.run.fleets.steps import map_drive
from segslam.run.sessions.recorded import Session
from segslam.scans import open_dataset
from segslam.slam.adjustment import submaps
from segslam.slam.slam import Slam

pytestmark = [pytest.mark.long, pytest.mark.usefixtures("short_runs")]
SETTINGS = ("adjustment.max_minutes=0",)


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Monday, a stranger, a damaged one, and friday."""
    root = tmp_path_factory.mktemp("recordings")
    monday = write_day(root / "monday", day=0, first=0, num_scans=22)
    friday = write_day(root / "friday", day=1, first=6, num_scans=22)
    damaged = root / "damaged.mcap"
    damaged.write_bytes(b"no recording")
    return [monday, write_mcap(root / "stranger.mcap", clouds(8)), damaged, friday]


def _drives(recordings: list[Path]) -> list[Drive]:
    """From a list in YAML; the fixes of the recordings in one file are too few for a place."""
    file = recordings[0].parent / "drives.yaml"
    reference = open_dataset(recordings[0]).reference
    assert reference is not None
    few = file.with_name("few.csv")
    if not few.exists():  # a drive is mapped again if a file of it is new
        write_fixes(few, reference.stamp_ns[:2], reference.T_world_lidar[:2])
    in_file = {"topic": TOPIC, "gnss": "few.csv"}
    entries = [{"data": path.name} | in_file if path.suffix else _on_globe(path) for path in recordings]
    file.write_text(json.dumps(entries))
    return read_drives(file)


def _on_globe(data: Path) -> dict[str, str]:
    """A recording with the fixes of a receiver beside it."""
    fixes = data.with_suffix(".csv")
    reference = open_dataset(data).reference
    if not fixes.exists() and reference is not None:
        write_fixes(fixes, reference.stamp_ns, reference.T_world_lidar)
    return {"data": data.name, "gnss": fixes.name}


@pytest.fixture(scope="module")
def joined(recordings: list[Path], tmp_path_factory: pytest.TempPathFactory) -> FleetResult:
    out = tmp_path_factory.mktemp("fleets") / "city é"
    return fleet(_drives(recordings), out, same_reference=True, settings=SETTINGS)


def test_drives_that_share_places_are_in_one_frame_and_the_others_alone(joined: FleetResult) -> None:
    values = json.loads((joined.folder / FILE).read_text())
    assert {name: one["state"] for name, one in values["drives"].items()} == {
        "monday": "mapped",
        "stranger": "mapped",
        "damaged": "failed",
        "friday": "mapped",
    }
    assert [one["drives"] for one in values["components"]] == [["monday", "friday"], ["stranger"]]
    assert values["drives"]["friday"]["component"] == 0
    assert values["drives"]["damaged"]["component"] is None
    assert "damaged.mcap" in values["drives"]["damaged"]["reason"]
    assert values["num_loops_between"] >= 3
    assert values["components"][0]["ate_m"] < 0.15
    assert set(values["seconds"]) == {"map", "index", "propose", "relate", "join"}
    assert "damaged.mcap" in (joined.folder / "report.html").read_text()


def test_a_component_is_a_run_with_the_poses_of_each_drive(joined: FleetResult) -> None:
    component = read_run(joined.folder / "component_0")
    friday = read_run(joined.folder / "runs" / "friday")
    own = read_poses(component.folder / "drives" / "friday_tum.txt")
    assert own.stamp_ns is not None
    np.testing.assert_allclose(own.stamp_ns, friday.result.trajectory.stamp_ns, atol=1000)
    last = component.result.trajectory.T_world_lidar[-len(own) :]
    np.testing.assert_allclose(own.T_a_b, last, atol=1e-5)
    alone = read_run(joined.folder / "component_1")
    assert alone.dataset == read_run(joined.folder / "runs" / "stranger").dataset


def test_drives_with_fixes_are_on_the_globe_alone_and_together(joined: FleetResult) -> None:
    """Both drives end where they were: the fixes of both place the component."""
    component = np.loadtxt(joined.folder / "component_0" / "poses_geodetic.csv", delimiter=",", skiprows=1)
    alone = [
        np.loadtxt(joined.folder / "runs" / name / "poses_geodetic.csv", delimiter=",", skiprows=1)
        for name in ("monday", "friday")
    ]
    apart_m = enu_from_geodetic(component[:, 1:4], ORIGIN) - enu_from_geodetic(np.vstack(alone)[:, 1:4], ORIGIN)
    assert np.hypot(*apart_m[:, :2].T).max() < 0.4
    values = json.loads((joined.folder / "component_0" / "georeference.json").read_text())
    assert values["num_fixes"] == len(component)
    assert not (joined.folder / "component_1" / "georeference.json").exists()


def test_fixes_that_cannot_be_read_end_a_drive_before_it_is_mapped(recordings: list[Path], tmp_path: Path) -> None:
    drive = Drive("monday", str(recordings[0]), gnss=str(tmp_path / "none.csv"))
    with pytest.raises(SegslamError, match=r"none\.csv"):
        map_drive(tmp_path, drive)
    assert list(tmp_path.iterdir()) == []


def _made(folder: Path) -> dict[str, int]:
    """All files but those that each call writes, with their times."""
    files = (file for file in folder.rglob("*") if file.is_file())
    return {str(file): file.stat().st_mtime_ns for file in files if file.name not in (FILE, "report.html")}


@pytest.mark.slow
def test_what_is_done_is_not_done_again_and_the_failed_drive_is_tried_again(
    joined: FleetResult, recordings: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "again"
    shutil.copytree(joined.folder, folder)
    (folder / "runs" / f".friday.{'0123' * 8}.part").mkdir()
    before = _made(folder)
    tried = []
    map_folder = segslam.run.fleets.steps.map_folder

    def mapped(data: Path, *arguments: Any, **options: Any) -> Any:
        tried.append(data.name)
        return map_folder(data, *arguments, **options)

    monkeypatch.setattr("segslam.run.fleets.steps.map_folder", mapped)
    again = fleet(_drives(recordings), folder, same_reference=True, settings=SETTINGS)
    assert again.drives == joined.drives
    assert _made(folder) == before
    assert tried == [], "the damaged drive fails before it is mapped"
    assert not (folder / "runs" / f".friday.{'0123' * 8}.part").exists()
    (recordings[2].parent / "damaged.mcap").rename(recordings[2].parent / "kept")
    try:
        write_mcap(recordings[2], clouds(8))
        whole = fleet(_drives(recordings), folder, same_reference=True, settings=SETTINGS)
    finally:
        (recordings[2].parent / "kept").replace(recordings[2])
    assert whole.drives["damaged"]["state"] == "mapped"
    assert tried == ["damaged.mcap"]


@pytest.mark.slow
def test_an_added_drive_needs_its_own_loops_and_alignments_only_and_the_component_is_the_same(
    recordings: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    aligned: list[int] = []
    searched: list[int] = []
    align, take = submaps.align, Slam.take

    def counted(*arguments: Any) -> Any:
        aligned.append(1)
        return align(*arguments)

    def taken(self: Slam, step: Step, below: int, optimize: bool) -> Step:
        searched.extend([1] if below else [])
        return take(self, step, below=below, optimize=optimize)

    sunday = write_day(tmp_path / "sunday", day=2, first=3, num_scans=22)
    days = [recordings[0], recordings[3], sunday]
    fleet(days[:2], tmp_path / "grown", num_workers=1)
    fleet(days[2:], tmp_path / "mapped", num_workers=1)
    shutil.copytree(tmp_path / "mapped" / "runs" / "sunday", tmp_path / "grown" / "runs" / "sunday")
    shutil.copytree(tmp_path / "grown" / "runs", tmp_path / "at once" / "runs")
    monkeypatch.setattr(submaps, "align", counted)
    monkeypatch.setattr(Slam, "take", taken)
    counts, poses = [], []
    for name in ("grown", "at once"):
        aligned.clear()
        searched.clear()
        result = fleet(days, tmp_path / name, num_workers=1)
        assert [one["drives"] for one in result.components] == [["monday", "friday", "sunday"]]
        poses.append(read_run(result.folder / "component_0").result.trajectory.T_world_lidar)
        counts.append((len(aligned), len(searched)))
    np.testing.assert_allclose(poses[0], poses[1], rtol=0, atol=1e-9)
    (num_aligned, num_searched), (num_aligned_at_once, num_searched_at_once) = counts
    assert 0 < num_aligned < 0.8 * num_aligned_at_once
    assert 0 < num_searched < 0.8 * num_searched_at_once


def test_the_run_of_a_drive_is_read_once_until_its_log_changes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(steps, "read_session", lambda log: Session.__new__(Session))
    drive = steps.Mapped("monday", "key")
    log = drive.folder(tmp_path) / "log.mcap"
    log.parent.mkdir(parents=True)
    log.write_bytes(b"")
    first = steps._session(tmp_path, drive)
    assert steps._session(tmp_path, drive) is first
    os.utime(log, ns=(1, 1))
    assert steps._session(tmp_path, drive) is not first


@pytest.mark.slow
def test_two_processes_write_the_same_poses(recordings: list[Path], tmp_path: Path) -> None:
    """As commands, each in a process of its own: after an hour of other tests in this one, zeros differ by 1e-20."""
    pytest.importorskip("distributed")
    _drives(recordings)
    words = [
        sys.executable,
        "-m",
        "segslam",
        "fleet",
        recordings[0].parent / "drives.yaml",
        "--set",
        *SETTINGS,
        "--out",
    ]
    for workers_ in ("1", "2"):
        subprocess.run([*words, tmp_path / workers_, "--workers", workers_, "--quiet"], check=True)
    one, two = (json.loads((tmp_path / number / FILE).read_text()) for number in ("1", "2"))
    assert one["drives"] == two["drives"]
    for name in ("poses_tum.txt", "loops.csv", "graph.g2o"):
        first, second = ((tmp_path / number / "component_0" / name).read_bytes() for number in ("1", "2"))
        if name == "loops.csv":  # which has times
            first, second = (
                b"\n".join(line.rsplit(b",", 4)[0] for line in text.splitlines()) for text in (first, second)
            )
        assert first == second, name


def test_settings_of_dask_are_those_of_the_program_again(tmp_path: Path) -> None:
    pytest.importorskip("distributed")
    import dask

    key = "distributed.worker.daemon"
    before = dask.config.get(key)
    with workers.workers(tmp_path, number=2, scheduler=None):
        assert dask.config.get(key) is False, "also for a worker that is started again"
    assert dask.config.get(key) is before is not False


class _Client:
    """Workers that answer with a version, and see the folder or not."""

    def __init__(self, found: Any, sees: bool = True) -> None:
        self._answers = [{"tcp://a": found}, {"tcp://a": sees}]

    def run(self, *_: Any, **__: Any) -> Any:
        return self._answers.pop(0)


@pytest.mark.parametrize(
    ("client", "message"),
    [
        (_Client("0.0.1"), r"worker tcp://a: has segslam 0\.0\.1, this is .*; install the same version"),
        (_Client(ModuleNotFoundError("segslam")), "cannot import segslam"),
        (_Client(segslam.__version__, sees=False), "does not see .*; give a folder that all workers share"),
    ],
)
def test_a_worker_that_cannot_take_part_is_refused(client: _Client, message: str, tmp_path: Path) -> None:
    with pytest.raises(SegslamError, match=message):
        workers._check(client, tmp_path, "tcp://b")


def test_without_dask_several_processes_are_refused_with_the_remedy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("dask", "distributed"):
        monkeypatch.setitem(sys.modules, name, None)
    with (
        pytest.raises(SegslamError, match="need Dask: pip install"),
        workers.workers(tmp_path, number=2, scheduler=None),
    ):
        pass


def test_nothing_mapped_is_an_error_with_the_first_reason(
    recordings: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("fleet", recordings[2], "--out", tmp_path / "none", "-q") == 2
    assert "no drive could be mapped; damaged: " in capsys.readouterr().err
    assert run("fleet", tmp_path / "nothing.yaml", "--out", tmp_path / "none") == 2
    (tmp_path / "some.yaml").write_text("- monday\n")
    assert run("fleet", tmp_path / "some.yaml", recordings[0], "--out", tmp_path / "none") == 2
    assert "some.yaml: a list of drives; give it alone" in capsys.readouterr().err
    assert run("fleet", recordings[0], "--out", tmp_path / "x", "--scheduler", "tcp://x:1", "--workers", "2") == 2
    assert "--workers: " in capsys.readouterr().err


def test_missing_files_of_a_drive_are_named_before_the_others_are_mapped(
    recordings: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    said = list[str]()

    def mapped(_: Path, drive: Drive) -> None:
        said.append(f"map {drive.name}")
        raise SegslamError("not now")

    monkeypatch.setattr(steps, "map_drive", mapped)
    drives = [
        Drive("friday", str(recordings[3])),
        Drive("gone", "/no/where"),
        Drive("x", str(recordings[0]), config="/no.y"),
    ]
    with pytest.raises(SegslamError, match="no drive could be mapped"):
        fleet(drives, tmp_path / "city", num_workers=1, say=said.append)
    missing = [f"{what}: no such file or folder; the others go on" for what in ("gone: /no/where", "x: /no.y")]
    assert said[:3] == [*missing, "map friday"]


def test_a_component_of_one_drive_is_shown_without_loops(
    recordings: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    alone, two = {"drives": ["a"], "ate_m": 0.0041}, {"drives": ["b", "c"], "num_loops_between": 3}
    result = FleetResult(tmp_path, {}, (alone, two), {})
    monkeypatch.setattr(segslam.run.fleets.orchestrate, "fleet", lambda *_, **__: result)
    monkeypatch.chdir(tmp_path)
    assert run("fleet", recordings[0], "--out", "city") == 0
    shown = capsys.readouterr().err
    assert shown.endswith("report: city/report.html (open it in a browser)\n")
    assert "component 0: a; error 0.004 m\ncomponent 1: b, c; 3 loops between them\n" in shown


def test_a_file_that_is_no_drive_is_named_once_and_leaves_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "junk.txt").write_text("no drive\n")
    (tmp_path / "more.txt").write_text("no drive either\n")
    assert run("fleet", tmp_path / "junk.txt", tmp_path / "more.txt", "--out", tmp_path / "city") == 2
    shown = capsys.readouterr().err
    assert shown.count(f"junk: {tmp_path / 'junk.txt'}: found neither") == 1
    assert shown.count(f"more: {tmp_path / 'more.txt'}: found neither") == 1
    assert not (tmp_path / "city").exists()


@pytest.mark.slow
def test_the_command_shows_steps_and_components_in_a_terminal(recordings: list[Path], tmp_path: Path) -> None:
    drives = [str(recordings[0]), str(recordings[3])]
    settings = ("--set", SETTINGS[0])
    status, output = in_terminal("-m", "segslam", "fleet", *drives, "--out", str(tmp_path / "city"), *settings)
    assert status == 0, output
    assert "friday is joined to monday by" in output
    assert "component 0: monday, friday" in output


def test_what_an_interrupted_step_left_is_removed(tmp_path: Path) -> None:
    def killed(part: Path) -> None:
        part.write_bytes(b"half")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        steps._replace(tmp_path / "index" / "a-1.npy", killed)
    assert len(list((tmp_path / "index").iterdir())) == 1
    steps.remove_unfinished(tmp_path)
    assert list((tmp_path / "index").iterdir()) == []


def test_a_run_that_is_not_of_the_fleet_is_not_replaced(recordings: list[Path], tmp_path: Path) -> None:
    own = tmp_path / "runs" / "monday"
    own.mkdir(parents=True)
    (own / "log.mcap").write_text("made by segslam map")
    with pytest.raises(SegslamError, match=r"runs/monday: not made by segslam fleet"):
        map_drive(tmp_path, Drive("monday", str(recordings[0])))
    assert [file.name for file in tmp_path.rglob("*") if file.is_file()] == ["log.mcap"]


def test_a_second_call_leaves_the_work_of_the_first_alone(recordings: list[Path], tmp_path: Path) -> None:
    with segslam.run.fleets.orchestrate._alone_in(tmp_path):
        part = steps._beside(tmp_path / "runs" / "monday")
        part.mkdir(parents=True)
        with pytest.raises(SegslamError, match="another call of segslam fleet works there"):
            fleet([str(recordings[0])], tmp_path)
        assert part.is_dir()
    foreign = tmp_path / ".drive.bag.partial"
    foreign.write_text("of another program")
    with segslam.run.fleets.orchestrate._alone_in(tmp_path):
        assert not part.exists()
    assert foreign.exists()


def test_kept_results_belong_to_drives_of_these_names(tmp_path: Path) -> None:
    """Names become others when a drive of the same name is added."""

    def key_of(name: str) -> str:
        return steps._component_key([steps.Mapped(name, "key")], [None], same_reference=False)

    assert key_of("scans") != key_of("scans-1")
    (tmp_path / "index").mkdir()
    spectra = np.random.default_rng(0).integers(0, 255, (3, 24, 60), dtype=np.uint8)
    for name in ("scans", "scans-1", "other"):
        np.save(tmp_path / "index" / f"{name}-key.npy", spectra)
    for name in ("scans", "scans-1"):
        found = steps.propose(tmp_path, steps.Mapped("other", "key"), [steps.Mapped(name, "key")])
        assert set(found) == {name}


@pytest.mark.parametrize("content", [b"", b"\x93NUMPY", b"[1"])
@pytest.mark.parametrize("kept", ["index/monday-key.npy", "index/friday-key.npy", "proposals/friday-{}.json"])
def test_a_damaged_file_is_named_with_the_remedy(kept: str, content: bytes, tmp_path: Path) -> None:
    """As after a power failure; it is not made again, so the same call would fail again."""
    monday, friday = (steps.Mapped(name, "key") for name in ("monday", "friday"))
    for drive in (monday, friday):
        drive.signatures(tmp_path).parent.mkdir(exist_ok=True)
        np.save(drive.signatures(tmp_path), np.zeros((2, 24, 60), np.uint8))
    file = tmp_path / kept.format(steps.key_of([("monday", "key"), ("friday", "key")]))
    file.parent.mkdir(exist_ok=True)
    file.write_bytes(content)
    failure = workers.attempted(steps.propose, tmp_path, friday, [monday]).failure
    assert failure is not None
    assert failure.startswith(f"{file}: damaged (")
    assert failure.endswith("remove it, and call `segslam fleet` again")


def test_an_error_without_text_is_a_failure_with_its_name() -> None:
    def lost() -> None:
        raise ConnectionResetError

    assert workers.attempted(lost) == (None, "ConnectionResetError")
