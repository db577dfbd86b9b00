"""Fleets of simulated drives.

    python -m tools.benchmarks.fleet simulate POSES TOWNS [--frames N]
    python -m tools.benchmarks.fleet growth TOWNS OUT [--numbers 4,8,16,23] [--workers 1]
    python -m tools.benchmarks.fleet troubles TOWNS OUT [--number 4]
    python -m tools.benchmarks.fleet search FLEET [--numbers 10000,100000,1000000]

`simulate` writes 24 drives of six towns along KITTI's true poses, and each town in one drive. `growth` joins more and
more of them, prints ATE beside that of the town mapped at once, CPU and wall time and peak memory of the largest
process, and then adds one drive. `troubles` kills a worker in each step, the scheduler, and fills a disk; the result
must have the same bytes as without trouble, and nothing finished may be done twice. `search` measures the search for
similar places with the signatures of a finished fleet, repeated.
"""

import argparse
import json
import os
import subprocess
from pathlib import Path
from time import perf_counter, process_time
from typing import Any

import numpy as np

from segslam.candidates import Places, PlaceSignature
from tools.benchmarks.common import Row, markdown, parser, write_report
from tools.benchmarks.fleet.towns import NUM_FRAMES, drives_in, fleet_command, write_list, write_towns
from tools.benchmarks.fleet.troubles import troubles

NUM_QUERIES = 20


def main() -> None:
    """Run one of the benchmarks."""
    options = parser(__doc__, "fleet")
    kinds = options.add_subparsers(dest="kind", required=True)
    simulate, growth, trouble, search = map(kinds.add_parser, ("simulate", "growth", "troubles", "search"))
    simulate.add_argument("poses", type=Path)
    simulate.add_argument("towns", type=Path)
    simulate.add_argument("--frames", type=int, default=NUM_FRAMES)
    for kind in (growth, trouble):
        kind.add_argument("towns", type=Path)
        kind.add_argument("out", type=Path)
    growth.add_argument("--numbers", default="4,8,16,23")
    growth.add_argument("--workers", default="1")
    trouble.add_argument("--number", type=int, default=4)
    search.add_argument("fleet", type=Path)
    search.add_argument("--numbers", default="10000,100000,1000000")
    given = options.parse_args()
    if given.kind == "simulate":
        for name in write_towns(given.towns, given.poses, num_frames=given.frames):
            print(name, flush=True)
    elif given.kind == "growth":
        _growth(given)
    elif given.kind == "search":
        signatures = np.concatenate([np.load(file) for file in sorted((given.fleet / "index").glob("*.npy"))])
        print(markdown("Search", _search_costs(signatures, list(map(int, given.numbers.split(","))))))
    else:
        given.out.mkdir(parents=True, exist_ok=True)
        rows = troubles(given.out, drives_in(given.towns)[: given.number])
        print(markdown("Fleet: troubles", rows))
        write_report(given.out / "troubles.json", {"rows": rows})


def _growth(given: argparse.Namespace) -> None:
    """Each number of drives in a folder of its own; then another drive is added to the last."""
    given.out.mkdir(parents=True, exist_ok=True)
    drives, whole = drives_in(given.towns), drives_in(given.towns, whole=True)
    alone = _run(given.out / "whole", whole, given.workers)
    at_once = {name.split("_")[0]: one["ate_m"] for one in alone["components"] for name in one["drives"]}
    rows: list[Row] = []
    for number in map(int, given.numbers.split(",")):
        folder = given.out / f"of {number}"
        rows.append(_row(f"{number} drives", number, _run(folder, drives[:number], given.workers)))
        print(markdown("Fleet", rows), flush=True)
    ran = _run(folder, drives[: number + 1], given.workers)
    rows.append(_row(f"1 added to {number}", 1, ran))
    towns = [
        {"component": ", ".join(one["drives"]), "ATE (m)": one.get("ate_m"), "loops": one.get("num_loops_between", 0)}
        | {"mapped at once (m)": at_once[one["drives"][0].split("_")[0]]}
        for one in ran["components"]
    ]
    print(markdown("Fleet", rows), markdown("Towns", towns), sep="\n")
    write_report(given.out / "growth.json", {"rows": rows, "towns": towns})


def _run(folder: Path, drives: list[Path], workers: str) -> dict[str, Any]:
    """`fleet.json` of a call, and what it cost."""
    listed = write_list(folder.with_suffix(".yaml"), drives)
    arguments = fleet_command(listed, folder, "--workers", workers)
    started = perf_counter()
    _, status, used = os.wait4(subprocess.Popen(arguments).pid, 0)
    if status:
        raise SystemExit(f"{' '.join(arguments)} failed")
    result: dict[str, Any] = json.loads((folder / "fleet.json").read_text())
    cost = {"wall_s": perf_counter() - started, "cpu_s": used.ru_utime + used.ru_stime, "peak_mb": used.ru_maxrss / 1e3}
    return result | cost | {"bytes": sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())}


def _row(name: str, number: int, ran: dict[str, Any]) -> Row:
    steps = {f"{step} (s)": round(seconds, 1) for step, seconds in ran["seconds"].items()}
    return {
        "fleet": name,
        "components": len(ran["components"]),
        "loops between": ran["num_loops_between"],
        "CPU a drive (s)": round(ran["cpu_s"] / number, 1),
        "wall a drive (s)": round(ran["wall_s"] / number, 1),
        "largest process (MB)": round(ran["peak_mb"]),
        "disk a drive (MB)": round(ran["bytes"] / 1e6 / number, 1),
    } | steps


def _search_costs(signatures: np.ndarray, numbers: list[int]) -> list[Row]:
    """A row for each number of places. `signatures`: (n, 24, 60) of an index, repeated at other yaws."""
    places, rows, rng = Places(), list[Row](), np.random.default_rng(0)
    for number in numbers:
        while len(places) < number:
            drawn = np.roll(signatures[rng.integers(len(signatures))], rng.integers(60), axis=1)
            places.add(len(places), PlaceSignature(drawn))
        started = process_time()
        for query in signatures[:: max(1, len(signatures) // NUM_QUERIES)][:NUM_QUERIES]:
            places.shortlist(PlaceSignature(query))
        query_ms = round((process_time() - started) / NUM_QUERIES * 1e3, 2)
        megabytes = round(number * places.bytes_per_place / 1e6)
        rows.append({"places": number, "CPU a query (ms)": query_ms, "MB": megabytes})
    return rows


if __name__ == "__main__":
    main()
