import numpy as np
import pytest

from segslam import cli
from segslam.cli.warm_up import _street_seen_from
from segslam.config import load_config
from segslam.slam import Slam
from segslam.types import LoopClosure, Scan


def test_every_stage_works_on_the_street_of_the_warm_up() -> None:
    slam = Slam(load_config(None, ["proximity.min_travel_m=0", "keyframes.distance_m=0.1", "verify.min_overlap=0"]))
    steps = []
    for index in range(3):
        points = _street_seen_from(0.5 * index)
        steps.append(slam.process(Scan(index, index, points, np.zeros(len(points), np.uint8))))
    outcomes = [attempt.outcome for step in steps for attempt in step.attempts]
    assert any(isinstance(outcome, LoopClosure) for outcome in outcomes), outcomes


def test_it_says_when_all_is_compiled(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        cli.main(["warm-up"])
    assert ended.value.code == 0
    assert "ready in" in capsys.readouterr().err
