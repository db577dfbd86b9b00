"""The package as a program uses it: names, scans from arrays, results, runs in one call."""

import contextlib
import io
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from evo.tools import file_interface
from helpers.drives import round_drive, write_kitti_sequence
from helpers.finished_run import MadeRun, make_run

import segslam
from segslam.core.pose_files import read_poses, write_kitti, write_tum
from segslam.core.trajectory import camera_from_lidar
from segslam.output.finished import FinishedRun


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> MadeRun:
    return make_run(tmp_path_factory.mktemp("made") / "run")


def test_completion_and_help_show_the_public_names() -> None:
    assert set(segslam.__all__) < set(dir(segslam))
    assert "import_module" not in dir(segslam)
    text = io.StringIO()
    with contextlib.redirect_stdout(text):
        help(segslam)
    for name in ("map_folder(", "open_dataset(", "read_run(", "register(", "class Slam", "class Scan"):
        assert name in text.getvalue()


def test_every_public_name_is_there_and_the_version_is_that_of_the_package() -> None:
    assert all(hasattr(segslam, name) for name in segslam.__all__)
    assert segslam.__version__ == __import__("importlib.metadata").metadata.version("segslam")
    with pytest.raises(AttributeError, match="no attribute 'regsiter'"):
        _ = segslam.regsiter


def test_points_and_a_stamp_are_a_scan() -> None:
    scan = segslam.Scan([[1, 2, 3, 0.5], [4, 5, 6, 0.7]], 10)  # type: ignore[arg-type]
    np.testing.assert_array_equal(scan.points, [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
    np.testing.assert_array_equal(scan.labels, [0, 0])
    assert (scan.stamp_ns, scan.index) == (10, None)
    kept = np.zeros((2, 3), np.float32)
    assert np.shares_memory(segslam.Scan(kept, 0).points, kept)


def test_labels_times_and_intensities_may_be_lists() -> None:
    scan = round_drive()[0][0]
    num = len(scan.points)
    lists = segslam.Scan(scan.points, 0, None, scan.labels.tolist(), [0.0] * num, [0.5] * num)
    keyframe = segslam.Slam().process(lists).keyframe
    assert keyframe is not None
    assert len(keyframe.labels) == len(keyframe.points) > 0
    found = segslam.register(scan.points, scan.points, source_labels=scan.labels.tolist(), target_labels=scan.labels)
    assert not isinstance(found, segslam.Rejected)


@pytest.mark.parametrize("points", [np.zeros((4, 2)), np.zeros(6), [["x", "y", "z"]]])
def test_other_arrays_than_points_are_rejected(points: object) -> None:
    with pytest.raises(segslam.SegslamError, match="points:"):
        segslam.Scan(points, 0)  # type: ignore[arg-type]


def test_slam_counts_scans_that_have_no_number() -> None:
    slam = segslam.Slam()
    for scan in round_drive()[0][:3]:
        slam.process(segslam.Scan(scan.points, scan.stamp_ns))
    with pytest.raises(segslam.BadScan, match="scan 3: its stamp"):
        slam.process(segslam.Scan(scan.points, scan.stamp_ns))
    assert slam.finish().trajectory.scan_index.tolist() == [0, 1, 2]


def test_two_scans_are_registered_as_they_come_from_files() -> None:
    scans, truth = round_drive()
    source, target = (np.column_stack([scans[k].points, np.ones(len(scans[k].points))]) for k in (53, 2))
    found = segslam.register(source, target.astype(np.float32).tolist())
    assert found.ok
    expected = np.linalg.inv(truth.T_world_lidar[2]) @ truth.T_world_lidar[53]
    np.testing.assert_allclose(found.T_target_source[:3, 3], expected[:3, 3], atol=0.3)
    assert found.T_target_source is found.fine.T_target_source
    with pytest.raises(segslam.SegslamError, match="shape"):
        segslam.register(source[:, :2], target)


def test_a_result_is_written_as_other_tools_read_it(made: MadeRun, tmp_path: Path) -> None:
    made.result.to_tum(tmp_path / "tum.txt")
    made.result.to_kitti(str(tmp_path / "kitti.txt"))
    expected = made.result.trajectory.T_world_lidar
    tum = file_interface.read_tum_trajectory_file(str(tmp_path / "tum.txt"))
    np.testing.assert_allclose(tum.poses_se3, expected, atol=1e-6)
    np.testing.assert_allclose(read_poses(tmp_path / "kitti.txt").T_a_b, expected, atol=1e-6)


def test_errors_are_those_of_the_matching_scans(made: MadeRun) -> None:
    figures = made.result.errors(made.truth)
    assert figures["ate_m"] == pytest.approx(made.result.errors(made.truth.T_world_lidar)["ate_m"])
    assert figures["ate_m"] < 0.1  # its keyframes are true, and what is between them nearly
    with pytest.raises(segslam.SegslamError, match="for 120 scans"):
        made.result.errors(made.truth.T_world_lidar[:-1])


def test_a_result_is_drawn_and_kept_as_plain_values(made: MadeRun) -> None:
    figure = made.result.plot(made.truth)
    labels = [text.get_text() for text in figure.axes[0].get_legend().get_texts()]
    assert labels == ["reference", "odometry", "corrected", "loops (4)"]
    values = json.loads(json.dumps(made.result.to_dict()))
    np.testing.assert_allclose(values["T_world_lidar"], made.result.trajectory.T_world_lidar)
    assert [loop["weight"] for loop in values["loops"]] == [1.0, 0.9, 1.0, 0.0]


def test_a_folder_is_mapped_in_one_call(tmp_path: Path) -> None:
    write_kitti_sequence(tmp_path / "kitti", num_scans=5)
    steps = []
    run = segslam.map_folder(tmp_path / "kitti", tmp_path / "run", on_step=steps.append)
    assert isinstance(run, FinishedRun)
    assert len(steps) == len(run.result.trajectory) == run.metrics["num_scans"] == 5
    assert run.metrics["ate_m"] < 0.5
    assert (tmp_path / "run" / "report.html").is_file()
    assert segslam.read_run(str(tmp_path / "run")).metrics == run.metrics


def test_a_folder_without_usable_scans_is_an_error(tmp_path: Path) -> None:
    velodyne = write_kitti_sequence(tmp_path / "kitti", num_scans=2)
    for file in velodyne.iterdir():
        file.write_bytes(b"")
    with pytest.raises(segslam.SegslamError, match=r"none of 2 scans could be used; the first: .*\.bin"):
        segslam.map_folder(tmp_path / "kitti", tmp_path / "run")


@pytest.mark.long
def test_a_run_is_evaluated_exported_and_reported_by_public_names(made: MadeRun, tmp_path: Path) -> None:
    run = segslam.read_run(made.folder)
    figures = segslam.evaluate(run)
    assert figures["ate_m"] == pytest.approx(made.result.errors(made.truth)["ate_m"])
    made.result.to_tum(tmp_path / "tum.txt")
    write_tum(tmp_path / "true.txt", made.truth.stamp_ns, made.truth.T_world_lidar)
    for estimate, reference in (
        (run.result.trajectory, made.truth),
        (run.result.trajectory.T_world_lidar, made.truth.T_world_lidar),
        (tmp_path / "tum.txt", str(tmp_path / "true.txt")),
        (run.result.trajectory.T_world_lidar, tmp_path / "true.txt"),
        (made.folder, None),
        (str(made.folder / "log.mcap"), None),
        (made.truth, made.folder),
    ):
        assert segslam.evaluate(estimate, reference)["ate_m"] == pytest.approx(figures["ate_m"], rel=1e-4)
    assert segslam.evaluate(run, up=(0, 0, 2)) == figures
    assert run.T_camera_lidar is not None
    before = np.eye(4)[None].repeat(run.result.trajectory.scan_index[0], axis=0)  # the drive has scans before the run
    of_camera = np.concatenate([before, camera_from_lidar(made.truth.T_world_lidar, run.T_camera_lidar)])
    write_kitti(tmp_path / "poses.txt", of_camera)
    assert segslam.evaluate(run, tmp_path / "poses.txt") == pytest.approx(figures, rel=1e-3, abs=1e-3)
    with pytest.raises(segslam.SegslamError, match="one for each"):
        segslam.evaluate(run.result.trajectory.T_world_lidar[:-1], made.truth.T_world_lidar)
    with pytest.raises(segslam.SegslamError, match="rpe_distance_m=0; give a distance above 0"):
        segslam.evaluate(run, rpe_distance_m=0)
    with pytest.raises(segslam.SegslamError, match="no ground truth"):
        segslam.evaluate(run.result.trajectory)
    with pytest.raises(segslam.SegslamError, match=r"give finite matrices, \(n, 4, 4\)"):
        segslam.evaluate(np.full((5, 4, 4), np.nan), made.truth.T_world_lidar)
    assert segslam.report(str(made.folder)) == made.folder / "report.html"
    assert segslam.report(made.folder / "log.mcap") == made.folder / "report.html"
    assert segslam.export(made.folder, tmp_path / "map.ply")["num_map_points"] > 0
    assert (tmp_path / "map.ply").is_file()
    with pytest.raises(segslam.SegslamError, match="given twice"):
        segslam.export(made.folder, [tmp_path / "a.kml", tmp_path / "a.kml"])


def test_odd_arguments_are_refused_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(segslam.SegslamError, match="fleet: no drive"):
        segslam.fleet([], tmp_path / "city")
    for out in (tmp_path, tmp_path / "scans" / "city"):  # all would be mapped again by the next call
        with pytest.raises(segslam.SegslamError, match=r"inside the recording .*; give another --out"):
            segslam.fleet([tmp_path], out)
    assert list(tmp_path.iterdir()) == []


WRONG_KINDS = {
    "segslam.Slam('x.yaml')": "x.yaml is not a Config",
    "segslam.Slam({})": "{} is not a Config",
    "segslam.Slam().process(np.ones((5, 3)))": "scan: a ndarray; give a Scan, as in Scan(points, stamp_ns)",
    "segslam.map_folder('.', 'run', config='x.yaml')": "x.yaml is not a Config",
    "segslam.merge(['.'], 'run', config=5)": "5 is not a Config",
    "segslam.merge('.', 'run')": "1 run given",
    "segslam.merge([], 'run')": "0 runs given",
    "segslam.register(np.ones((3, 3)), np.ones((3, 3)), config='x.yaml')": "x.yaml is not a Config",
    "segslam.load_config(5)": "5: not a path",
    "segslam.load_config(base='x.yaml')": "x.yaml is not a Config",
    "segslam.Locator(made)": "is not a Session; for a run: Locator.from_run(FOLDER)",
    "segslam.open_dataset(5)": "5: not a path",
    "segslam.open_dataset(None)": "None: not a path",
    "segslam.map_folder(5, 'run')": "5: not a path",
    "segslam.map_folder('.', None)": "None: not a path",
    "segslam.map_folder('kitti', 'run', odometry='lio.txt')": "odometry: lio.txt is not an Odometry",
    "segslam.read_run(5)": "5: not a path",
    "segslam.replay(5, 'run')": "5: not a path",
    "segslam.merge(5, 'run')": "5: not a path",
    "segslam.merge(['.', 5], 'run')": "5: not a path",
    "segslam.report(None)": "None: not a path",
    "segslam.export(5, 'map.ply')": "5: not a path",
    "segslam.locate(5, np.ones((5, 3)))": "5: not a path",
    "segslam.localise(None, '.', 'run')": "None: not a path",
    "segslam.georeference(5, 'fixes.csv')": "5: not a path",
    "segslam.open_dataset('.', frames=5)": "frames 5: give a text, 'A:B'",
    "segslam.open_dataset('kitti', sequence=0)": "sequence 0: give a text, for example '00'",
    "segslam.open_dataset('kitti', labels=5)": "labels 5: give a text",
    "segslam.open_dataset('kitti', vertical_angle_deg=np.nan)": "vertical_angle_deg: Input should be a finite number",
    "segslam.open_dataset('kitti', vertical_angle_deg=[1])": "vertical_angle_deg: Input should be a valid number",
    "segslam.fleet(5, 'fleet')": "5: not a path",
    "segslam.export(made, 5)": "5: not a path",
    "segslam.fleet(['.'], 'fleet', num_workers=0)": "num_workers=0",
    "segslam.fleet(['kitti'], 'fleet', settings=5)": "settings 5: give texts, each section.key=value",
    "segslam.export(made, 'map.ply', settings=5)": "settings 5: give texts",
    "segslam.replay(made, 'run', settings=None)": "settings None: give texts",
    "segslam.load_config(None, [5])": "settings [5]: give texts",
    "segslam.Scan(np.ones((5, 3)), 0.5)": "stamp_ns 0.5: give integer nanoseconds",
    "segslam.Scan(np.ones((5, 3)), 0, times=np.ones(3))": "3 times for 5 points",
    "segslam.Scan(np.ones((2, 3)), 0, times=[0, np.nan])": "times: not all are numbers from 0",
    "segslam.Scan(np.ones((2, 3)), 0, times=[0, 1e8])": "times: not all are numbers from 0",
    "segslam.Scan(np.ones((2, 3)), 0, times=[0, 1], sweep_s=-0.1)": "sweep_s -0.1: give the duration of a sweep",
    "segslam.Scan(np.ones((2, 3)), 0, times=[0, 1], stamp_time=2.0)": "stamp_time 2.0: give 0 for the start",
    "segslam.Scan(np.ones((2, 3)), 0, times=np.zeros((2, 1, 2)))": "4 times for 2 points",
    "segslam.Scan(np.ones((5, 3)), 0, 2.5)": "index 2.5: give an integer, or None",
    "segslam.Scan(np.ones((5, 3)), 0, labels=np.ones(2, np.uint8))": "2 labels for 5 points",
    "segslam.Scan(np.ones((5, 3)), 0, labels=['road'] * 5)": "labels: not an array of numbers",
    "segslam.Scan(np.ones((2, 3)), 0, labels=[9, 65545])": "labels: 65545 is not a learning id",
    "segslam.Scan(np.ones((2, 3)), 0, labels=lambda: [9, 40]).labels()": "labels: 40 is not a learning id",
    "segslam.Scan(np.ones((2, 3)), 0, labels=lambda: np.zeros(3)).labels()": "labels: 3 labels for 2 points",
    "segslam.Scan(np.ones((2, 3)), 0, labels=lambda: None).labels()": "labels: not an array of numbers",
    "print(segslam.Scan(np.ones((2, 3)), 0, labels=lambda: [9.0, 1]).labels().dtype)": "uint8",
    "segslam.register(np.ones((2, 3)), np.ones((2, 3)), source_labels=[9, 40])": "labels: 40 is not a learning id",
    "segslam.Scan(np.ones((5, 3)), 0, intensities=np.ones(3))": "intensities: 3 for 5 points",
    "segslam.Scan(np.ones((2, 3)), 0, intensities=['a', 'b'])": "intensities: 2 for 2 points; give one number for each",
    "segslam.evaluate(np.eye(4)[None], np.eye(4)[None], align='Sim3')": "align='Sim3': unknown; known: se3",
    "segslam.evaluate(np.zeros((3, 4, 4)), np.ones((3, 4, 4)))": "evaluate: a matrix is not a pose",
    "segslam.evaluate(segslam.Config(), made)": "evaluate: Config() is no array; give finite matrices",
    "segslam.evaluate(made, up=(0, 0, 0))": "evaluate: up=(0, 0, 0); give the direction",
    "segslam.evaluate(made, up='z')": "evaluate: up=z; give the direction",
    "segslam.read_run(made).result.errors(2 * np.repeat(np.eye(4)[None], 120, axis=0))": "reference: a matrix is not a",
    "segslam.read_run(made).result.to_tum(5)": "5: not a path",
    "segslam.read_run(made).result.to_kitti('no/such/poses.txt')": "poses.txt: there is no folder no/such",
    "segslam.Locator.from_run(made).locate(np.ones((5, 3)), max_places=-1)": "max_places=-1: give a number of places",
    "segslam.read_run(made).result.errors('poses.txt')": "reference: poses.txt is no array",
    "segslam.fleet('~unknown-user/drives.yaml', 'fleet')": "there is no user with this name",
    "segslam.read_run('scan.bin')": "not a run",
    "segslam.read_run('')": "empty text: give a path, `.` for this folder",
    "segslam.map_folder('kitti', '')": "empty text: give a path, `.` for this folder",
    "segslam.read_run('x' * 5000)": f"{'x' * 80}...: File name too long; give another path",
    "segslam.map_folder('x' * 300, 'run')": f"{'x' * 80}...: File name too long; give another path",
    "segslam.evaluate(made, 'x' * 300)": f"{'x' * 80}...: File name too long; give another path",
    "segslam.merge([made, 'x' * 300], 'run')": f"{'x' * 80}...: File name too long; give another path",
}


def test_arguments_of_a_wrong_kind_are_refused_by_name(made: MadeRun, tmp_path: Path) -> None:
    """In another process, where no test checks the types."""
    np.ones((200, 4), "<f4").tofile(tmp_path / "scan.bin")
    write_kitti_sequence(tmp_path / "kitti", num_scans=1)
    lines = ["import numpy as np", "import segslam", f"made = {str(made.folder)!r}"]
    for call in WRONG_KINDS:
        lines += ["try:", f"    {call}", "except segslam.SegslamError as error:", "    print(error)"]
    script = "\n".join(lines)
    done = subprocess.run([sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    complaints = done.stdout.splitlines()
    assert [one for one, said in zip(WRONG_KINDS.values(), complaints, strict=True) if one not in said] == []
    assert {file.name for file in tmp_path.iterdir()} == {"scan.bin", "kitti"}


@pytest.mark.long
def test_a_run_is_replayed_with_other_settings(tmp_path: Path) -> None:
    write_kitti_sequence(tmp_path / "kitti", num_scans=5)
    first = segslam.map_folder(tmp_path / "kitti", tmp_path / "run")
    again = segslam.replay(first.folder, tmp_path / "again", settings=["verify.max_false_share=0.01"])
    assert again.config.verify.max_false_share == 0.01
    assert len(again.result.trajectory) == 5
    assert again.metrics["kiss_icp_ate_m"] == pytest.approx(first.metrics["kiss_icp_ate_m"])
    with pytest.raises(segslam.SegslamError, match="a replay uses the keyframes"):
        segslam.replay(first.folder, tmp_path / "no", settings=["odometry.voxel_size_m=0.7"])
    assert not (tmp_path / "no").exists()


def test_representations_are_short_and_say_what_matters(made: MadeRun, tmp_path: Path) -> None:
    assert repr(segslam.Config()) == "Config()"
    changed = segslam.load_config(None, ["verify.max_false_share=0.01", "graph.final=gnc"])
    assert set(repr(changed)[7:-1].split(", ")) == {"verify.max_false_share=0.01", "graph.final='gnc'"}
    slam = segslam.Slam()
    slam.process(round_drive()[0][0])
    assert repr(slam) == "Slam(1 scan, 1 keyframe, 0 loops, running)"
    write_kitti_sequence(tmp_path / "kitti", num_scans=3)
    scans = segslam.open_dataset(tmp_path / "kitti")
    assert repr(scans) == f"KittiSequence({scans.name!r}, 3 scans)"
    run = segslam.read_run(made.folder)
    assert repr(run).startswith(f"FinishedRun('{made.folder}', 120 scans")
    html = run._repr_html_()
    assert "<svg" in html
    assert "scans mapped" in html
