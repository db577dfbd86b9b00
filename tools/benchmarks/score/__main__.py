"""Command line of the benchmark of the score."""

import argparse
import json
import pickle
from argparse import Namespace
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy.special import expit

from segslam.core.config import Config, load_config
from segslam.verification.patches import BINS
from segslam.verification.score import Table
from tools.benchmarks import common, score
from tools.benchmarks.scene_models import SCENES
from tools.benchmarks.scenes import Task, tasks
from tools.benchmarks.score import ratio
from tools.benchmarks.score.pairs import described, of_drive, of_towns
from tools.benchmarks.score.ratio import Best, Pair

DRIVES = ("kitti_whole", "nclt", "courtyard", "town")
SHARE = Config().verify.max_false_share
TENTHS = np.linspace(0.0, 1.0, 11)


def main() -> None:
    parser = argparse.ArgumentParser("score", description=score.__doc__, formatter_class=argparse.RawTextHelpFormatter)
    jobs = parser.add_subparsers(dest="job", required=True)
    describe = jobs.add_parser("describe")
    describe.add_argument("data", type=Path, help="folder with nclt/, courtyard/, kitti_whole/ (unpacked) and town/")
    describe.add_argument("--parts", default=",".join((*SCENES, *DRIVES)))
    describe.add_argument("--sensors", default="70 wide,16,64,non-repeating,32,90 high,128")
    describe.add_argument("--noise", default="0.03,0.1,0.01", help="taken in turn by scenes and sensors")
    describe.add_argument("--pairs", type=int, default=5, help="true ones, and as many false ones, of each cell")
    describe.add_argument("--seed", type=int, default=40)
    common.add_settings(describe)
    describe.add_argument("--out", type=Path, required=True)
    learn = jobs.add_parser("learn")
    learn.add_argument("pairs", type=Path, nargs="+")
    learn.add_argument("--table", type=Path, required=True)
    test = jobs.add_parser("test")
    test.add_argument("pairs", type=Path, nargs="+")
    test.add_argument("--learnt", type=Path, nargs="+")
    test.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    {"describe": _describe, "learn": _learn, "test": _test}[options.job](options)


def _describe(options: Namespace) -> None:
    config = load_config(overrides=options.set)
    pairs: list[Pair] = []
    for task in _tasks(options, config):
        pairs.append(described(task, config))
        print(f"{pairs[-1].part}, {pairs[-1].sensor}: {len(pairs)} pairs, {pairs[-1].verdict}", flush=True)
    options.out.write_bytes(pickle.dumps(pairs))


def _tasks(options: Namespace, config: Config) -> Iterator[Task]:
    parts = options.parts.split(",")
    noises = [float(noise) for noise in options.noise.split(",")]
    drawn = partial(tasks, count=options.pairs, seed=options.seed, config=config)
    for turn, sensor in enumerate(options.sensors.split(",")):
        for number, name in enumerate(part for part in parts if part in SCENES):
            yield from drawn(name, sensor, noises[(turn + number) % len(noises)])
    for part in parts:
        if part == "town":
            yield from of_towns(options.data, count=options.pairs, seed=options.seed, config=config)
        elif part not in SCENES:
            yield from of_drive(part, options.data, count=options.pairs, seed=options.seed, config=config)


def _read(files: Sequence[Path]) -> list[Pair]:
    return [pair for file in files for pair in pickle.loads(file.read_bytes())]


def _learn(options: Namespace) -> None:
    pairs = _read(options.pairs)
    table = _shipped(pairs)
    content = {
        "made_by": "python -m tools.benchmarks.score learn",
        "pairs": len(pairs),
        "ratios": {name: round(float(value), 3) for name, value in zip(BINS, table.ratios, strict=True)},
        **{name: round(value, 3) for name, value in table.weights._asdict().items()},
        "margin": round(table.margin, 2),
    }
    options.table.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
    print(content)


def _shipped(pairs: Sequence[Pair]) -> Table:
    table = ratio.calibrated(ratio.learnt(pairs), ratio.calibration(pairs, ratio.left_out(pairs)))
    return replace(table, margin=ratio.margin(pairs, ratio.bests(pairs, table), SHARE))


def _test(options: Namespace) -> None:
    tested = _read(options.pairs)
    taught = tested if options.learnt is None else _read(options.learnt)
    scored: list[tuple[Best, float]] = []
    accepted: list[Best] = []
    for own, others in ratio.by_part(tested, taught):
        table = _shipped(others)
        bests = ratio.bests(own, table)
        scored += bests
        accepted += [best for best, odds in bests if odds >= table.least_odds(Config().verify)]
    parts = [_row(part, tested, accepted) for part in (*sorted({pair.part for pair in tested}), "")]
    figures = {"parts": parts, "curve": curve(scored), "tenths": tenths(scored)}
    for name, rows in figures.items():
        print(common.markdown(name, rows))
    common.write_report(options.out, figures)


def _row(part: str, pairs: Sequence[Pair], accepted: Sequence[Best]) -> common.Row:
    """What the package accepted, and what the table accepts that others taught; all parts if `part` is empty."""
    own = [pair for pair in pairs if not part or pair.part == part]
    found = [best for best in accepted if not part or best.pair.part == part]
    seen = [pair for pair in own if pair.overlap > 0.4]
    right = [best.pair for best in found if best.pose.is_right]
    return {
        "part": part or "all",
        "true": sum(pair.is_true for pair in own),
        "false": sum(not pair.is_true for pair in own),
        "tried_right": sum(any(pose.is_right and pose.is_allowed for pose in pair.poses) for pair in own),
        "package_right": sum(pair.verdict == "right" for pair in own),
        "package_wrong": sum(pair.verdict == "wrong" for pair in own),
        "right": len(right),
        "wrong": len(found) - len(right),
        "overlapping": len(seen),
        "right_of_them": sum(pair.overlap > 0.4 for pair in right),
        "seconds": round(float(np.mean([pair.seconds for pair in own])), 3),
    }


def curve(scored: Sequence[tuple[Best, float]]) -> list[common.Row]:
    """How many right poses are above the limit that lets so many wrong ones pass."""
    wrong = sorted((odds for best, odds in scored if not best.pose.is_right), reverse=True)
    right = np.array([odds for best, odds in scored if best.pose.is_right])
    return [
        {
            "wrong_accepted": number,
            "of": len(wrong),
            "log_odds_above": round(wrong[number], 2),
            "right_accepted": int((right > wrong[number]).sum()),
            "of_right": len(right),
        }
        for number in (0, 1, 2, 5, 10)
        if number < len(wrong)
    ]


def tenths(scored: Sequence[tuple[Best, float]]) -> list[common.Row]:
    """Poses by probability, at even prior odds: its mean and the share of right ones; both classes weigh the same."""
    probability = expit([odds for _, odds in scored])
    is_right = np.array([best.pose.is_right for best, _ in scored])
    weight = np.where(is_right, 0.5 / max(is_right.sum(), 1), 0.5 / max((~is_right).sum(), 1))
    rows: list[common.Row] = []
    for low, high in pairwise(TENTHS):
        within = (probability >= low) & ((probability < high) | (high == 1.0))
        if within.any():
            share = np.average(is_right[within], weights=weight[within])
            mean = np.average(probability[within], weights=weight[within])
            rows.append({"from": round(float(low), 1), "poses": int(within.sum()), "probability": mean, "right": share})
    return rows


if __name__ == "__main__":
    main()
