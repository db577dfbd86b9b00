"""Drives that a network labels: at keyframes only, once each, and as well as true labels do."""

import json
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from helpers.commands import run
from helpers.drives import drifting, round_drive, round_sweeps, write_kitti_sequence
from helpers.made_logs import boundaries
from helpers.made_networks import class_network
from helpers.trained_network import train_network

from segslam.bench.labelling import confusion
from segslam.bench.simulation.files import uncorrected
from segslam.core.pose_files import write_kitti
from segslam.core.types import LoopClosure
from segslam.labels.encodings import to_labels
from segslam.labels.label_files import read_ids
from segslam.labels.network import Network
from segslam.output.log import read_log

pytestmark = pytest.mark.usefixtures("short_runs")

CHANGED = ("keyframes.distance_m=4", "proximity.min_travel_m=60", "adjustment.max_minutes=0")
SETTINGS = ("--quiet", *(word for setting in CHANGED for word in ("--set", setting)))
SENSOR = {"field_of_view_deg": [-22.8, 22.5], "height": 64, "width": 1024}


class Mapped(NamedTuple):
    """A run: its figures, its closures, and how many scans a network labelled."""

    folder: Path
    metrics: dict[str, Any]
    closures: set[tuple[int, int]]
    num_inferences: int


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A drive with loops whose intensities are the points' learning ids, and an odometry that drifts by metres."""
    root = tmp_path_factory.mktemp("drive")
    for file in sorted(write_kitti_sequence(root).glob("*.bin")):
        returns = np.fromfile(file, "<f4").reshape(-1, 4)
        returns[:, 3] = to_labels(read_ids(file.parents[1] / "true_labels" / f"{file.stem}.label"), "raw")
        returns.tofile(file)
    write_kitti(root / "drift.txt", drifting(round_drive()[1]).T_world_lidar)
    return root


@pytest.fixture(scope="module")
def network(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Reads the class off the intensity: what is left to go wrong is the image, the votes and the order of rows."""
    return f"network:{class_network(tmp_path_factory.mktemp('network'), **SENSOR)}"


@pytest.fixture(scope="module")
def labelled_run(drive: Path, network: str, tmp_path_factory: pytest.TempPathFactory) -> Mapped:
    """With labels of that network."""
    return _mapped(drive, tmp_path_factory.mktemp("labelled") / "run", network)


@pytest.fixture(scope="module")
def true_run(drive: Path, tmp_path_factory: pytest.TempPathFactory) -> Mapped:
    """With true labels from files."""
    return _mapped(drive, tmp_path_factory.mktemp("true") / "run", "true_labels")


@contextmanager
def _counted() -> Iterator[Counter[str]]:
    """Counts the scans that networks label."""
    counts: Counter[str] = Counter()
    labels = Network.labels

    def counted(self: Network, *scan: np.ndarray) -> np.ndarray:
        counts["scans"] += 1
        return labels(self, *scan)

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(Network, "labels", counted)
        yield counts


def _mapped(drive: Path, out: Path, labels: str) -> Mapped:
    with _counted() as counts:
        options = ("--labels", labels, "--odometry", drive / "drift.txt", *SETTINGS)
        assert run("map", drive, "--out", out, *options) == 0
    outcomes = [attempt.outcome for step in read_log(out / "log.mcap").steps() for attempt in step.attempts]
    closures = {(found.source_id, found.target_id) for found in outcomes if isinstance(found, LoopClosure)}
    return Mapped(out, json.loads((out / "metrics.json").read_text()), closures, counts["scans"])


def test_a_network_labels_keyframes_only(labelled_run: Mapped) -> None:
    metrics = labelled_run.metrics
    assert labelled_run.num_inferences == metrics["num_keyframes"] < metrics["num_scans"] / 1.5
    assert metrics["stage_ms"]["label"]["median"] > 0


def test_a_replay_labels_nothing(labelled_run: Mapped, tmp_path: Path) -> None:
    with _counted() as counts:
        assert run("replay", labelled_run.folder / "log.mcap", "--out", tmp_path / "again", "--quiet") == 0
    assert counts["scans"] == 0


@pytest.mark.slow
def test_a_resumed_run_labels_the_keyframes_that_its_log_has_not(
    drive: Path, network: str, labelled_run: Mapped, tmp_path: Path
) -> None:
    ends = boundaries(labelled_run.folder / "log.mcap")
    log = (labelled_run.folder / "log.mcap").read_bytes()
    (tmp_path / "log.mcap").write_bytes(log[: ends[len(ends) // 2]])
    logged = sum(step.keyframe is not None for step in read_log(tmp_path / "log.mcap").steps())
    assert 0 < logged < labelled_run.metrics["num_keyframes"]
    options = ("--labels", network, "--odometry", drive / "drift.txt", "--quiet")
    with _counted() as counts:
        assert run("map", drive, "--out", tmp_path, "--resume", *options) == 0
    assert counts["scans"] == labelled_run.metrics["num_keyframes"] - logged


@pytest.mark.long
def test_a_network_that_knows_the_classes_closes_loops_as_true_labels_do(
    labelled_run: Mapped, true_run: Mapped
) -> None:
    _assert_as_good(labelled_run, true_run)


@pytest.mark.slow
def test_a_network_trained_in_other_towns_closes_loops_as_true_labels_do(true_run: Mapped, tmp_path: Path) -> None:
    """It has 83 to 87 % of the points right, as a real one may have in a place that it does not know."""
    root = tmp_path / "drive"
    files = sorted(write_kitti_sequence(root).glob("*.bin"))
    for file, one in zip(files, round_sweeps(), strict=True):
        returns = np.fromfile(file, "<f4").reshape(-1, 4)
        returns[:, 3] = one.intensity
        returns.tofile(file)
    write_kitti(root / "drift.txt", drifting(round_drive()[1]).T_world_lidar)
    lessons = [*round_sweeps(seed=7, only={0, 10, 20, 30, 40}), *round_sweeps(seed=8, only={5, 15, 25})]
    model = train_network(tmp_path, lessons)
    first = next(round_sweeps(only={33}))
    counts = confusion(Network(model).labels(uncorrected(first.points), first.intensity), first.labels)
    assert 0.75 < np.trace(counts) / counts.sum() < 0.95
    _assert_as_good(_mapped(root, tmp_path / "run", f"network:{model}"), true_run)


def _assert_as_good(found: Mapped, true_run: Mapped) -> None:
    """Error and loops within 10 % of those with true labels; the error is that of the loops, not of the odometry."""
    expected = len(true_run.closures)
    print(
        "FIGURES",
        len(found.closures),
        expected,
        found.metrics["ate_m"],
        true_run.metrics["ate_m"],
        true_run.metrics["odometry_ate_m"],
        found.metrics["num_candidates"],
        true_run.metrics["num_candidates"],
    )
    assert expected >= 5
    assert true_run.metrics["ate_m"] < true_run.metrics["odometry_ate_m"] / 2
    assert true_run.metrics["num_loops_false"] == found.metrics["num_loops_false"] == 0
    assert abs(len(found.closures) - expected) <= 0.1 * expected
    assert found.metrics["ate_m"] <= 1.1 * true_run.metrics["ate_m"]
