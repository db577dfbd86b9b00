"""Speed, memory and their growth, compared with KISS-ICP and KISS-SLAM. Writes JSON.

    python -m tools.benchmarks.speed DATA --sequence 06 --frames 0:400 --out speed.json
    python -m tools.benchmarks.speed DATA --only latency start --out speed.json --against before.json
    python -m tools.benchmarks.speed DATA --kiss-slam VENV/bin/python --out speed.json   (its pins need its own venv)

DATA is in KITTI's format, as `segslam simulate` writes it. Times are of the wall: on a machine with other work read
the ratios, whose two sides ran in turn, and the load average beside them.
"""

import argparse
import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from mcap.reader import make_reader

from segslam import keep_freed_memory, open_dataset
from segslam.core.config import Config
from segslam.output.log import schema
from segslam.slam.slam import Slam
from tools.benchmarks import common
from tools.benchmarks.speed.growth import curves, optimisation

RIVALS = Path(__file__).with_name("rivals.py")
REPEATS = 7
FIGURES = ("scans_per_second", "num_keyframes", "num_candidates", "num_loops_accepted", "peak_rss_mb", "stage_ms")
PACKAGES = ("segslam", "kiss-icp", "numpy", "numba", "gtsam", "small-gicp", "mcap")
DRIVE_SIZES = (1_000, 2_000, 5_000, 10_000)
GRAPH_SIZES = (1_000, 2_000, 5_000, 10_000, 20_000, 50_000)
LARGE_GRAPH = (100_000, 20_000)
"""Poses and closures."""
FALSE_SHARE = 0.2


def throughput(
    data: Path, sequence: str, frames: tuple[int, int], *, kiss_slam: Path | None, labels: str, rounds: int
) -> dict[str, Any]:
    """Medians over the rounds, in each of which all run one after the other, and the ratios to bare KISS-ICP."""
    pythons = {"kiss-icp": sys.executable, "kiss-icp-1": sys.executable}
    if kiss_slam is not None:
        pythons["kiss-slam"] = str(kiss_slam)
    found: dict[str, list[dict[str, Any]]] = {name: [] for name in ("segslam", *pythons)}
    for _ in range(rounds):
        found["segslam"].append(_mapped(data, sequence, frames, labels))
        for name, python in pythons.items():
            command = [python, str(RIVALS), name, str(data), sequence, *map(str, frames)]
            found[name].append(json.loads(_output(command).splitlines()[-1]))
    result: dict[str, Any] = {name: _median_of(runs) for name, runs in found.items()}
    for name in pythons:
        ratios = [
            a["scans_per_second"] / b["scans_per_second"] for a, b in zip(found["segslam"], found[name], strict=True)
        ]
        result[name]["segslam_is_faster_by"] = statistics.median(ratios)
    return result | {"labels": labels, "frames": list(frames), "rounds": rounds, "load_average": os.getloadavg()[0]}


def _mapped(data: Path, sequence: str, frames: tuple[int, int], labels: str) -> dict[str, Any]:
    """One run of the command, with the memory that its log records."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        command = [sys.executable, "-m", "segslam", "map", str(data), "--sequence", sequence, "--out", str(out)]
        options = ["--frames", f"{frames[0]}:{frames[1]}", "--labels", labels, "--json", "--quiet"]
        before = _cpu_seconds()
        metrics = json.loads(_output([*command, *options]))
        cpu_ms = 1e3 * (_cpu_seconds() - before) / metrics["num_scans"]
        return {name: metrics[name] for name in FIGURES} | {"cpu_ms_per_scan": cpu_ms} | memory(out / "log.mcap")


def memory(log: Path) -> dict[str, float]:
    """Growth of the resident memory, in MB per 1,000 scans, over the second half of a run: what a longer one adds."""
    with log.open("rb") as stream:
        messages = make_reader(stream).iter_messages(topics=[schema.MEMORY])
        rss_mb = np.array([json.loads(message.data)["rss_mb"] for _, _, message in messages])
    half = len(rss_mb) // 2
    slope = np.polyfit(np.arange(half, len(rss_mb)), rss_mb[half:], 1)[0] if half > 1 else 0.0
    return {"growth_mb_per_1000_scans": float(1000 * slope)}


def _cpu_seconds() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _output(command: list[str]) -> str:
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


def _median_of(runs: list[dict[str, Any]]) -> dict[str, Any]:
    """The median of each number; of what is no number, that of the last run."""
    return {
        name: statistics.median(run[name] for run in runs) if isinstance(value, (int, float)) else value
        for name, value in runs[-1].items()
    }


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


def latency(data: Path, sequence: str, frames: tuple[int, int], *, labels: str) -> dict[str, Any]:
    """Milliseconds of `process`, of odometry in it, of all else, and of the steps that tried a loop."""
    slam = Slam(Config())
    dataset = open_dataset(data, sequence=sequence, frames=f"{frames[0]}:{frames[1]}", labels=labels)
    steps = [slam.process(scan) for scan in dataset]
    odometry = np.array([1e3 * step.stage_seconds["odometry"] for step in steps])
    total = np.array([1e3 * sum(step.stage_seconds.values()) for step in steps])
    tried = np.array([bool(step.attempts) for step in steps])
    return {
        "process_ms": common.spread(total),
        "odometry_ms": common.spread(odometry),
        "all_else_ms": common.spread(total - odometry),
        "with_loops_ms": common.spread(total[tried]),
        "share_with_loops": float(tried.mean()),
        "labels": labels,
    }


def measures(options: argparse.Namespace) -> dict[str, Callable[[], Any]]:
    """Name of a part -> what measures it."""
    first, last = (int(number) for number in options.frames.split(":"))
    scans = (options.data, options.sequence, (first, last))
    return {
        "throughput": lambda: throughput(
            *scans, kiss_slam=options.kiss_slam, labels=options.labels, rounds=options.rounds
        ),
        "latency": lambda: latency(*scans, labels=options.labels),
        "start": start,
        "growth": lambda: curves(GRAPH_SIZES, DRIVE_SIZES),
        "large_graph": lambda: optimisation(*LARGE_GRAPH, false_share=FALSE_SHARE),
    }


def numbers(values: Any, path: str = "") -> Iterator[tuple[str, float]]:
    """Every number of a nested record, with its path."""
    if isinstance(values, dict):
        for name, value in values.items():
            yield from numbers(value, f"{path}.{name}" if path else name)
    elif isinstance(values, (int, float)) and not isinstance(values, bool):
        yield path, float(values)


def compared(now: dict[str, Any], before: dict[str, Any]) -> list[str]:
    """A line for each figure that both have: now, before, and their ratio."""
    old = dict(numbers(before))
    return [
        f"{path:60} {value:12.4g} {old[path]:12.4g} {value / old[path]:8.2f}"
        for path, value in numbers(now)
        if old.get(path)
    ]


def main() -> None:
    parser = common.parser(__doc__, "speed")
    parser.add_argument("data", type=Path)
    parser.add_argument("--sequence", default="06")
    parser.add_argument("--frames", default="0:400", metavar="A:B")
    parser.add_argument("--labels", default="auto")
    parser.add_argument("--rounds", type=int, default=3, help="of throughput")
    parser.add_argument("--kiss-slam", type=Path, metavar="PYTHON", help="an interpreter that has kiss-slam")
    parser.add_argument("--only", nargs="+", metavar="PART")
    parser.add_argument("--against", type=Path, metavar="JSON")
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    keep_freed_memory()  # as the commands do
    parts = measures(options)
    if unknown := set(options.only or ()) - set(parts):
        parser.error(f"no part {', '.join(sorted(unknown))}; known: {', '.join(parts)}")
    figures = {name: measure() for name, measure in parts.items() if name in (options.only or parts)}
    common.write_report(options.out, {"packages": {name: version(name) for name in PACKAGES}} | figures)
    print(json.dumps(figures, indent=2))
    if options.against:
        print("\n".join(["figure, now, before, ratio", *compared(figures, json.loads(options.against.read_text()))]))


if __name__ == "__main__":
    main()
