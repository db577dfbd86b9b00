"""The adjustment of the whole map on finished runs: error, thickness and time before and after.

    python -m tools.benchmarks.adjustment OUT.json RUN[=POSES.txt] ... [--set adjustment.rounds=2]

POSES.txt: true poses in KITTI format, a line per scan, for runs without ground truth in their log. Runs are refined
into a scratch folder; their time of `map` is that of their `metrics.json`.
"""

import json
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter
from typing import Any

from segslam.output.accuracy import trajectory_accuracy
from segslam.output.finished import read_metrics, read_run, true_poses
from tools.benchmarks import common

FIGURES = (
    *("vertical_deg", "vertical_sigma_deg", "sweep_s", "sweep_sigma_s"),
    *("map_thickness_before_m", "map_thickness_m", "num_submap_pairs"),
)


def row(run: Path, poses: Path | None, settings: list[str]) -> dict[str, Any]:
    """The figures of one run."""
    before = read_run(run)
    reference = before.reference if poses is None else true_poses(poses, before)
    with TemporaryDirectory() as scratch:
        started = perf_counter()
        changes = [word for setting in settings for word in ("--set", setting)]
        common.segslam("refine", run, "--out", f"{scratch}/run", *changes)
        seconds = perf_counter() - started
        after = read_run(f"{scratch}/run")
        stages = read_metrics(after.folder)["stage_ms"]
    found: dict[str, Any] = {"run": run.name, "refine_s": seconds}
    found["adjustment_s"] = stages["adjust"]["median"] / 1000 if "adjust" in stages else None  # None: it is not used
    found["map_s"] = before.metrics["seconds_total"]
    found |= {name: after.metrics[name] for name in FIGURES if name in after.metrics}
    if reference is not None:
        for name, made in (("before", before), ("after", after)):
            figures = trajectory_accuracy(made.result.trajectory, reference)
            found |= {f"{key}_{name}": figures[key] for key in ("ate_m", "height_m") if key in figures}
    return found


def run_benchmark() -> None:
    """Write the rows to a file, and print them."""
    parser = common.parser(__doc__, "adjustment")
    parser.add_argument("out", type=Path)
    parser.add_argument("runs", nargs="+")
    common.add_settings(parser)
    options = parser.parse_args()
    rows = []
    for text in options.runs:
        run, _, poses = text.partition("=")
        rows.append(row(Path(run), Path(poses) if poses else None, options.set))
        print(json.dumps(rows[-1]))
    common.write_report(options.out, {"rows": rows})


if __name__ == "__main__":
    run_benchmark()
