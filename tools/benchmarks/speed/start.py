"""What the first command waits for: imports, and kernels that are compiled on first use."""

import os
import subprocess
import sys
import tempfile
import time
from typing import Any

import numpy as np

REPEATS = 7


def start() -> dict[str, Any]:
    """Seconds of `segslam --help` (median) and of `segslam warm-up`, kernels not yet cached and cached."""
    with tempfile.TemporaryDirectory() as cache:
        environment = os.environ | {"NUMBA_CACHE_DIR": cache}
        cold, warm = (_seconds("warm-up", environment) for _ in range(2))
    return {
        "help_s": float(np.median([_seconds("--help", dict(os.environ)) for _ in range(REPEATS)])),
        "bare_python_s": float(np.median([_seconds(None, dict(os.environ)) for _ in range(REPEATS)])),
        "warm_up_cold_s": cold,
        "warm_up_cached_s": warm,
    }


def _seconds(argument: str | None, environment: dict[str, str]) -> float:
    command = [sys.executable, "-m", "segslam", argument] if argument else [sys.executable, "-c", "pass"]
    started = time.perf_counter()
    subprocess.run(command, env=environment, capture_output=True, check=True)
    return time.perf_counter() - started
