"""Accuracy, speed and consistency of the registration of two scans: Markdown and JSON.

    python -m tools.benchmarks.registration DATA --cache DIR --out FILE.json
        [--parts real,simulated,negatives,speed,ablation] [--sequences 00,08] [--sample 20] [--seed 11] [--yaws 24]
        [--set segregator.gate=lengths ...]

DATA is the folder of real data. Simulated scans, at real poses of the sequences named and in a usual and a hard world,
are made where they are needed and kept in DIR, some 1.5 MB each. The gates of `VerifyConfig` and the noise of
`RefineConfig` and `SegregatorConfig` were chosen on sequences 00 and 08 with seed 11: evaluate them on others.
"""

import argparse
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np

from segslam import keep_freed_memory
from segslam.bench.experiments.pairs import pair_trials
from segslam.core.config import Config, load_config
from segslam.labels.label_files import computed
from tools.benchmarks import common, real_pairs
from tools.benchmarks.common import Row, markdown
from tools.benchmarks.registration.ablation import Case, ablation
from tools.benchmarks.registration.attempts import scan_of, simulated
from tools.benchmarks.registration.real import real, real_negatives
from tools.benchmarks.registration.scans import BANDS_M, WORLDS, Labelled, SimulatedPlace, real_scan
from tools.benchmarks.registration.speed import many_correspondences, sizes, stages

Tables = dict[str, list[Row]]


def places(options: argparse.Namespace) -> list[SimulatedPlace]:
    return [
        SimulatedPlace(options.data, sequence, world, seed=options.seed, cache=options.cache)
        for sequence in options.sequences.split(",")
        for world in WORLDS
    ]


def simulated_part(options: argparse.Namespace, config: Config) -> Tables:
    rng = np.random.default_rng([options.seed, 7])
    return simulated(places(options), config, sample=options.sample, num_negatives=options.negatives, rng=rng)


def speed_part(options: argparse.Namespace, config: Config) -> Tables:
    @cache
    def network(index: int) -> Labelled:
        scan = real_scan(options.data, index, labels="predicted_labels")
        return scan.points, computed(scan.labels)

    trials = pair_trials(real_pairs.predicted_pairs(options.data), None)
    real_cases: list[Case] = [(trial, network) for trial in trials]
    simulated_cases = [case for place in places(options) for case in _cases(place, "given", options.sample)]
    scans = [(f"00 {index}", network(index)) for index in real_pairs.PREDICTED]
    return {
        "6,000 correspondences": many_correspondences(config, rng=np.random.default_rng(options.seed)),
        "Stages, real pairs": stages(real_cases, config),
        "Stages, simulated pairs": stages(simulated_cases, config),
        "Descriptions": sizes(scans, config),
    }


def ablation_part(options: argparse.Namespace, config: Config) -> Tables:
    tables: Tables = {}
    for labels in ("given", "shape"):
        cases = [
            case for place in places(options) for case in _cases(place, labels, options.sample, bands_m=BANDS_M[2:])
        ]
        tables[f"One thing taken away: 15-30 m, labels {labels}"] = ablation(cases, config, seed=options.seed)
    return tables


def _cases(
    place: SimulatedPlace, labels: str, sample: int, bands_m: tuple[tuple[int, int], ...] = BANDS_M
) -> list[Case]:
    scan = cache(scan_of(place, labels))
    return [(pair, scan) for band_m in bands_m for pair in place.pairs(band_m, sample)]


PARTS: dict[str, Callable[[argparse.Namespace, Config], Tables]] = {
    "real": lambda options, config: {
        "Real pairs, the source turned": real(options.data, config, num_yaws=options.yaws)
    },
    "simulated": simulated_part,
    "negatives": lambda options, config: {
        "Real scans that do not overlap": real_negatives(options.data, config, every=options.every)
    },
    "speed": speed_part,
    "ablation": ablation_part,
}


def main() -> None:
    parser = common.parser(__doc__, "registration")
    parser.add_argument("data", type=Path)
    parser.add_argument("--cache", type=Path, required=True, help="simulated scans are kept here")
    parser.add_argument("--out", type=Path, required=True, help="a .json file; the tables go to .md beside it")
    parser.add_argument("--parts", default=",".join(PARTS))
    parser.add_argument("--sequences", default="00,08")
    parser.add_argument("--sample", type=int, default=20, help="pairs of each band of distances")
    parser.add_argument("--negatives", type=int, default=500, help="of each place and source of labels")
    parser.add_argument("--every", type=int, default=4, help="of the courtyard's scans beside KITTI's")
    parser.add_argument("--yaws", type=int, default=24)
    parser.add_argument("--seed", type=int, default=11)
    common.add_settings(parser)
    options = parser.parse_args()
    unknown = set(options.parts.split(",")) - set(PARTS)
    if unknown:
        parser.error(f"--parts {','.join(sorted(unknown))}: choose from {','.join(PARTS)}")
    keep_freed_memory()  # as the commands do
    config = load_config(overrides=options.set)
    asked = {key: str(value) for key, value in vars(options).items() if key not in ("data", "cache", "out")}
    tables: Tables = {}
    for name in options.parts.split(","):
        for title, rows in PARTS[name](options, config).items():
            tables[title] = rows
            print(markdown(title, rows), flush=True)
    settings = config.model_dump(mode="json", include={"segregator", "refine", "verify", "geometric"})
    common.write_report(options.out, {"asked": asked, "tables": tables, "config": settings})
    text = "\n".join(markdown(title, rows) for title, rows in tables.items())
    options.out.with_suffix(".md").write_text(f"# Registration ({asked})\n\n{text}")


if __name__ == "__main__":
    main()
