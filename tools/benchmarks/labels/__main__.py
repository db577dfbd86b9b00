"""Accuracy of geometric labels: per class, and by the registrations with them.

    python -m tools.benchmarks.labels DATA [--set segregator.features=never] [--pictures FOLDER] --out FILE.json

DATA is the folder of real data: `kitti/` with ground-truth labels of scans 0-2, predicted ones, and
`reference_pairs.json`, and `courtyard/`. Writes JSON, and the tables as FILE.md. The numbers of `labels/geometric.py`
were chosen on those scans and pairs of KITTI. KISS-Matcher needs the extra `bench`.
"""

from pathlib import Path
from typing import Any

from segslam.bench.experiments.methods import find_method
from segslam.core.config import load_config
from segslam.scans import open_dataset
from tools.benchmarks import common
from tools.benchmarks.labels.measures import class_agreement, courtyard, pairs_by_labels, speed


def tables(results: dict[str, Any]) -> str:
    """The figures as Markdown."""
    iou = results["class_iou"]
    classes = [{"scans": scans} | {name: f"{iou[scans][name]:.2f}" for name in iou["all"]} for scans in sorted(iou)]
    kitti = [{"pairs": name} | _success(found) | _errors(found) for name, found in results["kitti"].items()]
    courtyard = [
        {"apart": band, "method": name}
        | _success(found)
        | {"CPU ms, median": f"{found['median_cpu_ms']:.0f}", "wall ms": f"{found['median_ms']:.0f}"}
        for band, methods in results["courtyard"].items()
        for name, found in methods.items()
    ]
    parts = {
        "Intersection over union": classes,
        f"Real pairs, {results['num_yaws']} yaws": kitti,
        "Courtyard": courtyard,
    }
    took = results["speed"]
    speed = f"Labels for {took['num_points']:,} points: {took['thread_ms_median']} ms (p95 {took['thread_ms_p95']})\n"
    return "\n".join([*(common.markdown(title, rows) for title, rows in parts.items()), speed])


def _success(found: dict[str, Any]) -> common.Row:
    success = f"{found['success_percent']:.1f} % of {found['num_pairs']}"
    return {"success": success, "false": found["num_false_accepted"]}


def _errors(found: dict[str, Any]) -> common.Row:
    row: common.Row = {}
    for kind in ("coarse", "refined"):
        (mean_m, worst_m), (mean_deg, worst_deg) = found[f"{kind}_m"], found[f"{kind}_deg"]
        row[f"{kind} mean (worst)"] = f"{mean_m:.3f} m {mean_deg:.2f} deg ({worst_m:.3f} m {worst_deg:.2f} deg)"
    return row


def main() -> None:
    parser = common.parser(__doc__, "labels")
    parser.add_argument("data", type=Path)
    parser.add_argument("--yaws", type=int, default=24)
    parser.add_argument("--pairs", type=int, default=60, help="of each band of distances in the courtyard")
    parser.add_argument(
        "--seed", type=int, default=0, help="of those pairs; 1 draws those that settings were chosen on"
    )
    common.add_settings(parser)
    parser.add_argument("--methods", default="segregator-c2f,kiss-matcher", help="of the courtyard")
    parser.add_argument("--pictures", type=Path, help="folder for pictures of a success and a failure")
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    config = load_config(overrides=options.set)
    methods = options.methods.split(",")
    for method in methods:
        find_method(method)
    first = open_dataset(options.data / "kitti", sequence="00", labels="none", frames="0:1")[0]
    results = {
        "num_yaws": options.yaws,
        "seed": options.seed,
        "config": config.model_dump(mode="json"),
        "class_iou": class_agreement(options.data),
        "speed": speed(first.points),
        "courtyard": courtyard(options, config, methods=methods),
        "kitti": pairs_by_labels(options.data, config, options.yaws),
    }
    common.write_report(options.out, results)
    options.out.with_suffix(".md").write_text(tables(results))
    print(tables(results))


if __name__ == "__main__":
    main()
