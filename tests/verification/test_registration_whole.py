"""Whole registrations: the same bits on any number of threads, and an answer or a clear refusal for any cloud."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers.drives import round_drive

from segslam.core.types import Alignment, Label, Rejected
from segslam.verification import register

DIGEST = """
import hashlib, sys
import numpy as np
from segslam.registration.prepared import prepare_scan
from segslam.verification import register_prepared
from segslam.core.config import Config, SegregatorConfig
config = Config(segregator=SegregatorConfig(features="always"))
stored = np.load(sys.argv[1])
source, target = (prepare_scan(stored[f"points{k}"], stored[f"labels{k}"], config=config) for k in range(2))
found = register_prepared(source, target, config=config)
parts = [getattr(source.description, name) for name in source.description.__slots__]
parts += [source.surface.points, source.free_space.nearest_m]
for registration in (found.coarse, found.fine):
    parts += [registration.T_target_source, registration.information]
print(hashlib.sha256(b"".join(part.tobytes() for part in parts)).hexdigest())
"""


def _digest(scans: Path, num_threads: int) -> str:
    names = ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    done = subprocess.run(
        [sys.executable, "-c", DIGEST, str(scans)],
        env=os.environ | dict.fromkeys(names, str(num_threads)),
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


@pytest.mark.long
def test_one_thread_and_two_give_the_same_bits(tmp_path: Path) -> None:
    scans, _ = round_drive()
    arrays = {f"{name}{k}": getattr(scans[i], name) for k, i in enumerate((3, 0)) for name in ("points", "labels")}
    np.savez(tmp_path / "scans.npz", **arrays)
    assert _digest(tmp_path / "scans.npz", 1) == _digest(tmp_path / "scans.npz", 2)


@pytest.mark.long
def test_two_million_points_are_registered() -> None:
    """Each point of two scans, many times over with noise."""
    scans, _ = round_drive()
    rng = np.random.default_rng(0)
    clouds = []
    for scan in (scans[3], scans[0]):
        rows = rng.integers(len(scan.points), size=2_000_000)
        clouds.append((scan.points[rows] + rng.normal(scale=0.01, size=(len(rows), 3)), scan.labels[rows]))
    (source, source_labels), (target, target_labels) = clouds
    found = register(source, target, source_labels=source_labels, target_labels=target_labels)
    assert isinstance(found, Alignment)


@pytest.mark.parametrize("label", [Label.CAR, Label.POLE, Label.ROAD, Label.BUILDING, Label.UNLABELLED])
def test_scans_of_a_single_class_are_registered_or_rejected(label: Label) -> None:
    scans, _ = round_drive()
    source, target = scans[3].points, scans[0].points
    found = register(
        source,
        target,
        source_labels=np.full(len(source), label, np.uint8),
        target_labels=np.full(len(target), label, np.uint8),
    )
    assert isinstance(found, (Alignment, Rejected))


def test_points_of_no_number_change_nothing() -> None:
    scans, _ = round_drive()
    points, labels = scans[3].points, scans[3].labels
    broken = np.concatenate([points, np.full((100, 3), np.nan), np.full((1, 3), np.inf), np.full((1, 3), 1e300)])
    labelled = np.concatenate([labels, np.full(102, Label.CAR, np.uint8)])
    target = {"target_points": scans[0].points, "target_labels": scans[0].labels}
    whole = register(points, source_labels=labels, **target)
    found = register(broken, source_labels=labelled, **target)
    assert isinstance(whole, Alignment)
    assert isinstance(found, Alignment)
    np.testing.assert_array_equal(found.fine.T_target_source, whole.fine.T_target_source)
