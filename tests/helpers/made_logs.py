"""Steps as a run makes them, of random numbers, and what tests of the log do with one."""

import resource
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from scipy.spatial.transform import Rotation

from segslam.core import geometry
from segslam.core.config import Config
from segslam.core.types import (
    Alignment,
    GraphEstimate,
    Keyframe,
    LoopAttempt,
    LoopCandidate,
    LoopClosure,
    Registration,
    Rejected,
    RejectReason,
    Step,
    Trajectory,
)
from segslam.output.log import LogWriter

CONFIG = Config()
RESOLUTION_M = CONFIG.keyframes.resolution_m


def pose(rng: np.random.Generator) -> np.ndarray:
    return geometry.transform(Rotation.random(random_state=rng).as_matrix(), rng.normal(scale=100.0, size=3))


def _registration(rng: np.random.Generator) -> Registration:
    return Registration(pose(rng), 120, 17, float(rng.random()), rng.random((6, 6)), 900)


def _closure(rng: np.random.Generator, source_id: int, target_id: int) -> LoopClosure:
    alignment = Alignment(_registration(rng), _registration(rng), 0.71, 0.083, 0.02)
    return LoopClosure(source_id, target_id, pose(rng), rng.random((6, 6)), alignment)


def _keyframe(rng: np.random.Generator, keyframe_id: int, scan_index: int, stamp_ns: int) -> Keyframe:
    steps = rng.integers(-25_000, 25_000, size=(200, 3))
    points = (steps * RESOLUTION_M).astype(np.float32)
    labels = rng.integers(0, 20, size=200).astype(np.uint8)
    return Keyframe(keyframe_id, scan_index, stamp_ns, pose(rng), 1.7 * keyframe_id, points, labels)


def made_steps(num_steps: int, seed: int = 0) -> Iterator[Step]:
    """A keyframe every other scan; from the tenth keyframe on an attempt each, every third accepted and optimised."""
    rng = np.random.default_rng(seed)
    poses: dict[int, np.ndarray] = {}
    weights: dict[tuple[int, int], float] = {}
    for index in range(num_steps):
        stamp_ns = 1_700_000_000_123_456_789 + 100_000_007 * index
        keyframe, attempts, estimate = None, (), None
        if index % 2 == 0:
            keyframe = _keyframe(rng, index // 2, index, stamp_ns)
            poses[keyframe.id] = pose(rng)
        if keyframe is not None and keyframe.id >= 10:
            pair = (keyframe.id, keyframe.id - 10)
            candidate = LoopCandidate(*pair, pose(rng), 3.3, 7.1 * np.eye(6), 0.9)
            accepted = keyframe.id % 3 == 0
            outcome = _closure(rng, *pair) if accepted else Rejected(RejectReason.LOW_OVERLAP, "0.31 < 0.5")
            attempts = (LoopAttempt(candidate, outcome, {"match": 0.021, "refine": 0.032}),)
            if accepted:
                weights[pair] = float(rng.random())
                estimate = GraphEstimate(dict(poses), float(rng.random()), dict(weights))
        yield Step(index, stamp_ns, pose(rng), keyframe, attempts, estimate, {"odometry": 0.041})


def made_result(steps: list[Step]) -> tuple[GraphEstimate, Trajectory]:
    keyframes = [step.keyframe for step in steps if step.keyframe is not None]
    estimate = GraphEstimate({keyframe.id: keyframe.T_odom_keyframe for keyframe in keyframes}, 2.5, {(10, 0): 0.0})
    scan_index, stamp_ns = (np.array([getattr(step, name) for step in steps]) for name in ("scan_index", "stamp_ns"))
    return estimate, Trajectory(scan_index, stamp_ns, np.stack([step.T_odom_lidar for step in steps]))


def write_log(path: Path, steps: list[Step], config: Config = CONFIG) -> Path:
    with LogWriter(path, config=config, dataset="kitti/00", replaces=True) as log:
        for step in steps:
            log.write(step)
    return path


def assert_same(a: Any, b: Any) -> None:
    """Equal to the last bit, but for the poses of estimates: they travel as quaternions."""
    assert type(a) is type(b)
    if isinstance(a, GraphEstimate):
        assert list(a.T_world_keyframe) == list(b.T_world_keyframe)
        for T_a, T_b in zip(a.T_world_keyframe.values(), b.T_world_keyframe.values(), strict=True):
            np.testing.assert_allclose(T_a, T_b, rtol=0, atol=4e-15)
        a, b = replace(a, T_world_keyframe={}), replace(b, T_world_keyframe={})
    if is_dataclass(a):
        for field in fields(a):
            assert_same(getattr(a, field.name), getattr(b, field.name))
    elif isinstance(a, np.ndarray):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)
    elif isinstance(a, tuple):
        for item_a, item_b in zip(a, b, strict=True):
            assert_same(item_a, item_b)
    else:
        assert a == b


def boundaries(path: Path) -> list[int]:
    """Where each step ends in the file."""
    with path.open("rb") as stream:
        chunks = make_reader(stream).get_summary().chunk_indexes
    return [chunk.chunk_start_offset + chunk.chunk_length for chunk in chunks]


def decoded(path: Path, topic: str) -> list[Any]:
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        return [item.decoded_message for item in reader.iter_decoded_messages(topics=[topic], log_time_order=False)]


@contextmanager
def largest_file(size: int) -> Iterator[None]:
    """The operating system refuses to let files grow beyond this size: a full disk that a test can have.

    Python writes no bytecode meanwhile: it does not notice that a file was cut short, and fails to load it later.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("sys.dont_write_bytecode", True)
        patched.setenv("PYTHONDONTWRITEBYTECODE", "1")
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
