"""Damaged files for all readers until the time is over: python -m fuzz [MINUTES] [--inputs N] [TARGET ...]"""

import argparse
import collections
import hashlib
import logging
import random
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path

from fuzz.children import Defect, defects
from fuzz.mutation import mutate
from fuzz.targets import Target, targets
from segslam.core.types import SegslamError

BATCH = 250
FOUND = Path("build/fuzz")


def main() -> int:
    """0 if no reader has a defect."""
    parser = argparse.ArgumentParser(prog="fuzz", description=__doc__)
    parser.add_argument("minutes", nargs="?", type=float, default=5.0)
    parser.add_argument("targets", nargs="*", help="names of readers; all by default")
    parser.add_argument("--inputs", type=int, default=10**9, help="most inputs for each reader")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    logging.disable(logging.CRITICAL)
    found: dict[str, list[Defect]] = collections.defaultdict(list)
    done: dict[str, int] = collections.Counter()
    spent: dict[str, float] = collections.Counter()
    end = time.monotonic() + 60.0 * options.minutes
    with tempfile.TemporaryDirectory() as folder:
        chosen = [one for one in targets(Path(folder)) if not options.targets or one.name in options.targets]
        warm_up(chosen)
        for number in range(options.seed * 10**6, options.seed * 10**6 + options.inputs // BATCH):
            for target in chosen:
                if time.monotonic() > end:
                    break
                started = time.monotonic()
                found[target.name] += defects(target.read, target.file, contents(target, number, BATCH))
                spent[target.name] += time.monotonic() - started
                done[target.name] += BATCH
            if time.monotonic() > end:
                break
    for target in chosen:
        print(f"{target.name:16} {done[target.name]:8} inputs {spent[target.name]:7.0f} s {_listed(target, found)}")
    return 1 if any(found.values()) else 0


def warm_up(chosen: list[Target]) -> None:
    """Read all valid contents once, so that libraries are loaded and kernels compiled before the time counts.

    Where a seed is only the start of random numbers, the content that follows from it may be damaged.
    """
    for target in chosen:
        for seed in target.seeds:
            target.file.write_bytes(seed)
            with suppress(SegslamError):
                target.read(target.file)


def contents(target: Target, number: int, num: int) -> list[bytes]:
    """Damaged contents; the same for the same number."""
    rng = random.Random(f"{target.name} {number}")
    return [mutate(rng, rng.choice(target.seeds), is_text=target.is_text) for _ in range(num)]


def _listed(target: Target, found: dict[str, list[Defect]]) -> str:
    """The defects by kind, the smallest content of each being kept in a file."""
    kinds: dict[str, list[bytes]] = collections.defaultdict(list)
    for kind, data in found[target.name]:
        kinds[kind].append(data)
    lines = [f"{len(found[target.name])} defects"]
    for kind, data in kinds.items():
        smallest = min(data, key=len)
        file = FOUND / target.name / f"{hashlib.sha1(smallest).hexdigest()[:12]}{target.file.suffix}"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(smallest)
        lines.append(f"    {len(data):6} {kind}: {file}")
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
