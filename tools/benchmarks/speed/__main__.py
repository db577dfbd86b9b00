"""Speed, memory and their growth, compared with KISS-ICP and KISS-SLAM. Writes JSON.

    python -m tools.benchmarks.speed DATA --sequence 06 --frames 0:400 --out speed.json
    python -m tools.benchmarks.speed DATA --only latency start --out speed.json --against before.json
    python -m tools.benchmarks.speed DATA --kiss-slam VENV/bin/python --out speed.json   (its pins need its own venv)

DATA is in KITTI's format, as `segslam simulate` writes it. Times are of the wall: on a machine with other work read
the ratios, whose two sides ran in turn, and the load average beside them.
"""

import argparse
import json
from collections.abc import Callable, Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any

from segslam import keep_freed_memory
from tools.benchmarks import common
from tools.benchmarks.speed.growth import curves, optimisation
from tools.benchmarks.speed.throughput import latency, start, throughput

PACKAGES = ("segslam", "kiss-icp", "numpy", "numba", "gtsam", "small-gicp", "mcap")
DRIVE_SIZES = (1_000, 2_000, 5_000, 10_000)
GRAPH_SIZES = (1_000, 2_000, 5_000, 10_000, 20_000, 50_000)
LARGE_GRAPH = (100_000, 20_000)
"""Poses and closures."""
FALSE_SHARE = 0.2


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
