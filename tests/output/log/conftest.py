"""A log with steps of all kinds, shared by the tests of this folder."""

from pathlib import Path

import pytest
from helpers.made_logs import made_steps, write_log

from segslam.core.types import Step


@pytest.fixture(scope="module")
def steps() -> list[Step]:
    return list(made_steps(60))


@pytest.fixture(scope="module")
def whole(steps: list[Step], tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_log(tmp_path_factory.mktemp("log") / "log.mcap", steps)
