"""Every method on two scans of a simulated street, and on scans that hold too little."""

import pickle
import sys
from typing import Any

import numpy as np
import pytest
from helpers.drives import round_drive

from segslam.bench.experiments.method_settings import METHOD_NAMES, method_config
from segslam.bench.experiments.methods import METHODS, find_method, prepare_parts
from segslam.core import geometry
from segslam.core.config import Config
from segslam.core.threads import Stopwatch
from segslam.core.types import Rejected, SegslamError

CONFIG = Config()
SOURCE, TARGET = 1, 0
"""2.2 m and 7 degrees apart: near enough for methods that start from the identity."""


def installed(name: str) -> str:
    if METHODS[name].package is not None:
        pytest.importorskip(METHODS[name].package)
    return name


@pytest.fixture(scope="module")
def parts() -> tuple[dict[str, Any], dict[str, Any]]:
    """All parts of source and target that all methods need."""
    scans, _ = round_drive()
    made = [
        prepare_parts(scans[i].points, scans[i].labels, methods=METHOD_NAMES, config=CONFIG) for i in (SOURCE, TARGET)
    ]
    (source, source_costs), (target, target_costs) = made
    assert all(cost.seconds > 0 for cost in (*source_costs.values(), *target_costs.values()))
    return source, target


def test_every_name_is_a_method() -> None:
    assert tuple(METHODS) == METHOD_NAMES


@pytest.mark.long
@pytest.mark.parametrize("name", METHOD_NAMES)
def test_a_method_finds_the_pose_of_two_near_scans(name: str, parts: tuple[dict[str, Any], dict[str, Any]]) -> None:
    """FPFH alone is inaccurate in simulated streets, so only the success criterion is tested for all methods."""
    found = find_method(installed(name)).align(*parts, CONFIG, Stopwatch())
    assert not isinstance(found, Rejected)
    _, truth = round_drive()
    T_true = geometry.inverse(truth.T_world_lidar[TARGET]) @ truth.T_world_lidar[SOURCE]
    error = found.T_target_source @ geometry.inverse(T_true)
    assert geometry.distance(error) < 2.0
    assert np.degrees(geometry.angle(error)) < 5.0
    if name == "segregator-c2f":
        assert geometry.distance(error) < 0.1


@pytest.mark.long
@pytest.mark.parametrize("name", ["segregator-c2f", "gicp", "vgicp", "fgr"])
def test_parts_sent_to_another_process_give_the_same_pose(
    name: str, parts: tuple[dict[str, Any], dict[str, Any]]
) -> None:
    there = [{part: pickle.loads(pickle.dumps(one[part])) for part in METHODS[name].parts} for one in parts]
    poses = [METHODS[name].align(*some, CONFIG, Stopwatch()).T_target_source for some in (parts, there)]
    np.testing.assert_allclose(poses[0], poses[1], atol=1e-9)


@pytest.mark.parametrize("name", ["segregator", "segregator-c2f", "teaser", "ransac", "fgr", "kiss-matcher"])
def test_a_method_that_finds_nothing_rejects(name: str) -> None:
    both = []
    for seed in range(2):
        points = 30 * np.random.default_rng(seed).normal(size=(12, 3)).astype(np.float32)
        both.append(prepare_parts(points, np.zeros(12, np.uint8), methods=[installed(name)], config=CONFIG)[0])
    assert isinstance(METHODS[name].align(*both, CONFIG, Stopwatch()), Rejected)


def test_quatro_turns_about_the_vertical_alone(parts: tuple[dict[str, Any], dict[str, Any]]) -> None:
    found = METHODS["quatro"].align(*parts, CONFIG, Stopwatch())
    np.testing.assert_allclose(found.T_target_source[2, :3], [0, 0, 1], atol=1e-12)


def test_settings_of_a_method_leave_all_else_as_it_was() -> None:
    changed = CONFIG.segregator.model_copy(update={"min_clique": 9})
    config = CONFIG.model_copy(update={"segregator": changed})
    segator = method_config(config, "segator")
    assert segator.segregator.gate == "lengths"
    assert segator.segregator.min_clique == 9
    assert method_config(config, "gicp") == config


def test_unknown_and_missing_methods_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(SegslamError, match="known: segregator"):
        find_method("magic")
    monkeypatch.setitem(sys.modules, "kiss_matcher", None)  # as if it were not installed
    with pytest.raises(SegslamError, match="pip install 'kiss-matcher<"):
        find_method("kiss-matcher")
