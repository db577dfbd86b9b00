"""Printed warnings."""

import logging
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from segslam.cli.console import FirstOfEachKind

pytestmark = pytest.mark.usefixtures("short_runs")


def test_first_warning_of_each_kind_is_printed_and_the_others_counted(capsys: pytest.CaptureFixture[str]) -> None:
    handler = FirstOfEachKind()
    logger = logging.getLogger("segslam.test_warnings")
    logger.addHandler(handler)
    try:
        for number in (3, 5, 9):
            logger.warning("scan %d is bad", number)
        logger.warning("the disk is slow")
        assert capsys.readouterr().err == ("segslam: WARNING: scan 3 is bad\nsegslam: WARNING: the disk is slow\n"), (
            "at once, not at the end"
        )
        handler.print_counts()
        assert capsys.readouterr().err == "segslam: 2 more warnings like this, the last: scan 9 is bad\n"
        handler.print_counts()
        assert capsys.readouterr().err == "", "once"
    finally:
        logger.removeHandler(handler)


@pytest.mark.long
def test_many_bad_scans_make_two_lines(tmp_path: Path) -> None:

    for number in range(6):
        points = np.ones((50, 4), np.float32) * (10.0 if number == 0 else 0.1)
        points.tofile(tmp_path / f"{number}.bin")
    command = [sys.executable, "-m", "segslam", "map", str(tmp_path), "--out", str(tmp_path / "run")]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    output = [line for line in done.stderr.splitlines() if "none of its 50 points" in line]
    assert len(output) == 2
    assert "scan 1" in output[0]
    assert output[1].startswith("segslam: 4 more warnings like this, the last: scan 5")
    assert "5 scans skipped (unreadable, empty, late or without a pose)" in done.stderr
