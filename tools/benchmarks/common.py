"""What the benchmarks have in common: their options, and the JSON and Markdown that they write."""

import argparse
import json
import math
from collections.abc import Mapping, Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np

from segslam.bench.experiments.provenance import commit, machine
from segslam.cli import main
from segslam.core import geometry
from segslam.core.evaluation import SUCCESS_DEG, SUCCESS_M
from segslam.core.types import Alignment, Rejected, Transform

RIGHT = 0.5, 2.0
"""m, degrees. Chosen: a refined pose that errs more is in another minimum; correct ones have errors of centimetres."""

Row = dict[str, Any]
"""A line of a table."""


@dataclass(frozen=True, slots=True)
class PoseError:
    """Error of one pose."""

    translation_m: float
    rotation_deg: float

    @classmethod
    def of(cls, T_error: Transform) -> "PoseError":
        """Length and angle of a transform that is the identity where there is no error."""
        return cls(geometry.distance(T_error), math.degrees(geometry.angle(T_error)))

    def within(self, translation_m: float, rotation_deg: float) -> bool:
        """Whether both errors are below these."""
        return self.translation_m < translation_m and self.rotation_deg < rotation_deg

    @property
    def success(self) -> bool:
        """By the rule of the Segregator paper."""
        return self.within(SUCCESS_M, SUCCESS_DEG)


def parser(doc: str | None, name: str) -> argparse.ArgumentParser:
    """A parser that shows the documentation of the module; `name` is that of the benchmark."""
    return argparse.ArgumentParser(
        prog=f"python -m tools.benchmarks.{name}",
        description=doc,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )


def add_settings(options: argparse.ArgumentParser) -> None:
    """Add `--set`, whose values `load_config` takes as overrides."""
    options.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE", help="may be repeated")


def segslam(*words: object) -> None:
    """Run a command in this process, without its output. Raises SystemExit if it fails."""
    with redirect_stderr(StringIO()), redirect_stdout(StringIO()):
        try:
            main([*map(str, words), "--quiet"])
        except SystemExit as ended:
            if ended.code:
                raise


def write_report(file: Path, figures: Mapping[str, Any]) -> None:
    """JSON of the figures, null where they are not finite, after the machine and the commit they were measured on."""
    report = json.dumps({"machine": machine(), "commit": commit()} | dict(figures))
    finite = json.loads(report, parse_constant=lambda _: None)
    file.write_text(json.dumps(finite, indent=1) + "\n", encoding="utf-8")


def spread(values: Sequence[float] | np.ndarray) -> dict[str, float]:
    """Median, 95th percentile and maximum; empty without values."""
    if not len(values):
        return {}
    median, p95, most = np.percentile(values, [50, 95, 100])
    return {"median": float(median), "p95": float(p95), "max": float(most)}


def markdown(title: str, rows: Sequence[Row]) -> str:
    """A table of rows with the same keys."""
    if not rows:
        return f"## {title}\n\nnothing\n"
    lines = [list(rows[0]), ["---"] * len(rows[0]), *(list(map(str, row.values())) for row in rows)]
    return f"## {title}\n\n" + "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def is_right(T_target_source: Transform, T_true: Transform | None, tolerance: tuple[float, float] = RIGHT) -> bool:
    """Whether the error of a refined pose is that of a correct one; False without a true pose: two other places."""
    return T_true is not None and PoseError.of(geometry.inverse(T_true) @ T_target_source).within(*tolerance)


def verdict(found: Alignment | Rejected, T_true: Transform | None, tolerance: tuple[float, float] = RIGHT) -> str:
    """`right`, `wrong`, or the reason of the rejection."""
    if isinstance(found, Rejected):
        return found.reason.value
    return "right" if is_right(found.fine.T_target_source, T_true, tolerance) else "wrong"


def draw_pairs(allowed: np.ndarray, count: int, rng: np.random.Generator) -> list[tuple[int, int]]:
    """Up to `count` different (row, column) of a matrix of flags, at random among those that are true."""
    sources, targets = np.nonzero(allowed)
    rows = rng.choice(len(sources), min(count, len(sources)), replace=False)
    return list(zip(sources[rows].tolist(), targets[rows].tolist(), strict=True))
