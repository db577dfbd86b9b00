"""Command line of the benchmark of the score."""

from argparse import Namespace
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

from segslam.bench.simulation.scenes import SCENES
from segslam.core.config import Config, load_config
from tools.benchmarks import common, score
from tools.benchmarks.score.pairs import Task, described, of_drive, of_scene
from tools.benchmarks.score.ratio import Pair, Score, Scored

DRIVES = ("kitti_whole", "nclt", "courtyard")
SHARES = (0.0, 0.01, 0.05)
"""Shares of the pairs without a right pose that the curve lets pass."""


def main() -> None:
    parser = common.parser(score.__doc__, "score")
    parser.add_argument("data", type=Path, help="folder with nclt/, courtyard/ and kitti_whole/ (unpacked)")
    parser.add_argument("--parts", default=",".join((*SCENES, *DRIVES)))
    parser.add_argument("--sensors", default="70 wide,16,64")
    parser.add_argument("--noise", default="0.03,0.1,0.01", help="taken in turn by scenes and sensors")
    parser.add_argument("--pairs", type=int, default=5, help="true ones, and as many false ones, of each part")
    parser.add_argument("--seed", type=int, default=21)
    common.add_settings(parser)
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    config = load_config(overrides=options.set)
    pairs: list[Pair] = []
    for task in _tasks(options, config):
        pairs.append(described(task, config))
        run = pairs[-1].run
        print(f"{run.part}, {run.sensor}: {len(pairs)} pairs, {pairs[-1].verdict}", flush=True)
    figures = compared(pairs)
    print(common.markdown("gates and score", figures["parts"]))
    print(common.markdown("score", figures["curve"]))
    common.write_report(options.out, figures)


def _tasks(options: Namespace, config: Config) -> Iterator[Task]:
    parts = options.parts.split(",")
    noises = [float(noise) for noise in options.noise.split(",")]
    drawn = partial(of_scene, count=options.pairs, seed=options.seed, config=config)
    for turn, sensor in enumerate(options.sensors.split(",")):
        for number, name in enumerate(part for part in parts if part in SCENES):
            yield from drawn(name, sensor, noises[(turn + number) % len(noises)])
    for part in parts:
        if part not in SCENES:
            yield from of_drive(part, options.data, count=options.pairs, seed=options.seed, config=config)


def compared(pairs: Sequence[Pair]) -> dict[str, list[common.Row]]:
    """Rows of the parts, each scored by what the others taught, and of the curve over all."""
    parts = sorted({pair.run.part for pair in pairs})
    scored: list[tuple[Pair, Scored, float]] = []
    rows: list[common.Row] = []
    for part in parts:
        taught = Score.learnt([pair for pair in pairs if pair.run.part != part])
        own = [pair for pair in pairs if pair.run.part == part]
        found = [(pair, one, taught.log_odds(one)) for pair in own if pair.poses for one in [taught.scored(pair, own)]]
        scored += found
        rows.append(_row(part, own, found))
    return {"parts": rows, "curve": [_point(scored, share) for share in SHARES]}


def _row(part: str, own: Sequence[Pair], found: Sequence[tuple[Pair, Scored, float]]) -> common.Row:
    wrong = [odds for _, one, odds in found if not one.best.is_right]
    most = max(wrong, default=-float("inf"))
    return {
        "part": part,
        "true": sum(pair.is_true for pair in own),
        "gates_right": sum(pair.verdict == "right" for pair in own),
        "gates_wrong": sum(pair.verdict == "wrong" for pair in own),
        "tried_right": sum(any(pose.is_right for pose in pair.poses) for pair in own),
        "best_right": sum(one.best.is_right for _, one, _ in found),
        "right_above_all_wrong": sum(one.best.is_right and odds > most for _, one, odds in found),
    }


def _point(scored: Sequence[tuple[Pair, Scored, float]], share: float) -> common.Row:
    """How many right poses are above the limit that lets this share of the wrong best poses pass."""
    wrong = sorted((odds for _, one, odds in scored if not one.best.is_right), reverse=True)
    limit = wrong[int(share * len(wrong))] if wrong else -float("inf")
    kept = sum(one.best.is_right and odds > limit for _, one, odds in scored)
    return {
        "false_share": share,
        "log_odds_above": round(limit, 2) if wrong else None,
        "kept": kept,
        "right": sum(one.best.is_right for _, one, _ in scored),
        "wrong": len(wrong),
    }


if __name__ == "__main__":
    main()
