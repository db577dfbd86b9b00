"""The look at the surroundings that chooses the settings of a live run."""

from collections.abc import Callable
from pathlib import Path
from threading import Event

import numpy as np
import pytest
from helpers.drives import round_drive

from segslam.cli.console import Terminal
from segslam.cli.preset import live_config
from segslam.core.errors import SegslamError
from segslam.core.types import BadScan, Scan, Transform
from segslam.run.live.waiting import Arrival, Waiting, extent_in_folder, extent_of_first
from segslam.scans.presets import extent_of, preset


def _ring(radius_m: float) -> np.ndarray:
    angles = np.linspace(0, 2 * np.pi, 500, endpoint=False)
    return np.column_stack([radius_m * np.cos(angles), radius_m * np.sin(angles), np.zeros(500)])


class OneScan:
    """A source with an unusable scan, then one with surfaces at 6 m."""

    name = "live/one"
    is_closed = False

    def open(self, tell: Callable[[str], None]) -> None:
        """Nothing to open."""

    def feed(self, waiting: Waiting, stopped: Event) -> str:
        """Two scans."""

        def bad(index: int, stamp_ns: int) -> Scan:
            raise BadScan("empty")

        waiting.put(1, bad)
        waiting.put(2, lambda index, stamp_ns: Scan(_ring(6.0), stamp_ns, index))
        stopped.wait(10)
        return ""

    def publish(self, arrival: Arrival, T_odom_lidar: Transform) -> None:
        """No subscribers."""

    def close(self) -> None:
        """Noted."""
        self.is_closed = True


def test_the_extent_of_a_live_source_is_that_of_its_first_usable_scan() -> None:
    source = OneScan()
    assert extent_of_first(source) == pytest.approx(6.0, abs=0.1)
    assert source.is_closed


def test_scans_in_the_folder_choose_the_preset_as_for_map(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "street").mkdir()
    for number, scan in enumerate(round_drive()[0][:2]):
        np.save(tmp_path / "street" / f"{number}.npy", scan.points)
    expected = np.median([extent_of(scan.points) for scan in round_drive()[0][:2]])
    assert extent_in_folder(tmp_path / "street") == pytest.approx(float(expected), rel=0.05)
    for number in range(3):
        np.save(tmp_path / f"{number}.npy", _ring(6.0))
    assert live_config("auto", tmp_path, None, Terminal()) == preset("indoor")
    assert "using --preset indoor" in capsys.readouterr().err


def test_without_scans_the_preset_is_driving_with_a_message(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert extent_in_folder(tmp_path) is None
    assert live_config("auto", tmp_path, None, Terminal()) == preset("driving")
    assert "no scan yet: using --preset driving" in capsys.readouterr().err
    assert live_config("campus", tmp_path, None, Terminal()) == preset("campus")
    with pytest.raises(SegslamError, match="unknown preset"):
        live_config("moon", tmp_path, None, Terminal(quiet=True))
