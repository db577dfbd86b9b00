"""Finished runs of real drives, georeferenced by real fixes and by fixes made worse.

    python -m tools.benchmarks.gnss RUN FIXES --out FILE.json [--truth-origin LAT,LON,HEIGHT] [--residuals POS TRUTH]

Prints for each alteration the error of the run without fixes and with them, after the best rigid motion, the error of
the heading of the map (the true poses placed by the fixes as they are), and, with `--truth-origin` (of the local frame
of the true poses), the horizontal error without any motion. `--residuals`: a file of RTKLIB and
the true positions as UrbanNav has them, whose differences are added to the fixes.
"""

import shutil
import tempfile
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from segslam.core import geometry
from segslam.core.evaluation import align_positions, trajectory_metrics
from segslam.core.trajectory import rows_of_same_scan
from segslam.core.types import Indices, Points, Transform
from segslam.gnss import Fixes, Origin, enu_from_geodetic, geodetic_from_enu
from segslam.gnss.reading import read_fixes
from segslam.output.finished import FinishedRun, read_run
from segslam.output.georeferenced import georeference, read_globe
from tools.benchmarks.common import Row, markdown, parser, write_report

SEED = 3401
WRONG_SHARE, WRONG_M, JUMP_M, JUMP_S = 0.3, 30.0, 50.0, 300.0
Alteration = Callable[[Fixes], Fixes]


def main() -> None:
    """Georeference copies of a run, once for each alteration."""
    options = parser(__doc__, "gnss")
    options.add_argument("run", type=Path)
    options.add_argument("fixes", type=Path)
    options.add_argument("--out", type=Path, required=True)
    options.add_argument("--truth-origin", type=lambda text: Origin(*map(float, text.split(","))))
    options.add_argument("--residuals", type=Path, nargs=2, metavar=("POS", "TRUTH"))
    given = options.parse_args()
    run, fixes = read_run(given.run), read_fixes(given.fixes)
    rows = []
    for name, altered in _alterations(given.residuals).items():
        rows.append({"fixes": name} | _row(run, altered(fixes), fixes, given.truth_origin))
        print(rows[-1], flush=True)
    print(markdown(run.folder.name, rows))
    write_report(given.out, {"run": run.folder.name, "rows": rows})


def _alterations(residuals: list[Path] | None) -> dict[str, Alteration]:
    made: dict[str, Alteration] = {
        "as they are": lambda fixes: fixes,
        "30 % single ones wrong by 30 m": _wrong,
        "30 % wrong by 30 m, in runs of 60 s": partial(_wrong, run_s=60.0),
        "a jump of 50 m that stays for 5 minutes": _jump,
        "clock 0.5 s off": lambda fixes: replace(fixes, stamp_ns=fixes.stamp_ns + 500_000_000),
    }
    made |= {f"third {third + 1} removed": partial(_without_third, third=third) for third in range(3)}
    if residuals:
        made["real residuals of a receiver in a city added"] = lambda fixes: _with_residuals(fixes, *residuals)
    return made


def _row(run: FinishedRun, fixes: Fixes, unaltered: Fixes, truth_origin: Origin | None) -> Row:
    assert run.reference is not None, "the run has no true poses"
    matches = rows_of_same_scan(run.result.trajectory.scan_index, run.reference.scan_index)
    truth = run.reference.T_world_lidar[matches[:, 1]]
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(shutil.copytree(run.folder, Path(folder) / "run"))
        placed = georeference(copy, fixes)
        globe = read_globe(copy)
    assert globe is not None
    poses = globe.T_enu_lidar[matches[:, 0]]
    before = trajectory_metrics(run.result.trajectory.T_world_lidar[matches[:, 0]], truth)["ate_m"]
    found: Row = {
        "kept": f"{placed.num_kept} of {len(fixes)}",
        "bent": placed.is_bent,
        "without (m)": round(before, 3),
        "with (m)": round(trajectory_metrics(poses, truth)["ate_m"], 3),
        "clock (s)": round(placed.measured_offset_s, 3),
    }
    T_enu_truth = np.eye(4)
    if truth_origin is None:
        stamps = run.result.trajectory.stamp_ns[matches[:, 0]]
        T_enu_truth = _placed(truth[:, :3, 3], stamps, unaltered, globe.origin)
    turn = align_positions(truth[:, :3, 3], poses[:, :3, 3]) @ geometry.inverse(T_enu_truth)
    found["heading (deg)"] = round(float(np.degrees(np.arctan2(turn[1, 0], turn[0, 0]))), 3)
    if truth_origin is not None:
        places = geodetic_from_enu(poses[:, :3, 3], globe.origin)
        off = enu_from_geodetic(places, truth_origin) - truth[:, :3, 3]
        found["unaligned, horizontal (m)"] = round(float(np.sqrt(np.mean(np.sum(off[:, :2] ** 2, axis=1)))), 3)
    return found


def _placed(positions: Points, stamp_ns: Indices, fixes: Fixes, origin: Origin) -> Transform:
    """The rigid motion of true positions to the fixes, which are all right."""
    within = fixes.usable & (fixes.stamp_ns >= stamp_ns[0]) & (fixes.stamp_ns <= stamp_ns[-1])
    there = np.column_stack([np.interp(fixes.stamp_ns[within], stamp_ns, column) for column in positions.T])
    return align_positions(there, enu_from_geodetic(fixes.places[within], origin))


def _moved(fixes: Fixes, shift_m: Points) -> Fixes:
    """Fixes moved east, north and up (n, 3)."""
    latitude, longitude, height_m = fixes.places[fixes.usable][0]
    origin = Origin(float(latitude), float(longitude), float(np.nan_to_num(height_m)))
    no_height = ~np.isfinite(fixes.places[:, 2])
    places = geodetic_from_enu(enu_from_geodetic(np.nan_to_num(fixes.places), origin) + shift_m, origin)
    places[no_height, 2] = np.nan
    places[~np.isfinite(fixes.places[:, 0])] = np.nan
    return replace(fixes, places=places)


def _wrong(fixes: Fixes, *, run_s: float = 0.0) -> Fixes:
    """A share of the fixes, or of the runs of this duration, is wrong by WRONG_M."""
    rng = np.random.default_rng(SEED)
    number = np.arange(len(fixes))
    if run_s:
        number = ((fixes.stamp_ns - fixes.stamp_ns[0]) // round(1e9 * run_s)).astype(int)
    is_wrong = rng.random(number.max() + 1) < WRONG_SHARE
    angle = rng.uniform(0.0, 2.0 * np.pi, len(is_wrong))
    directions = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(len(angle))])
    return _moved(fixes, (WRONG_M * directions * is_wrong[:, None])[number])


def _jump(fixes: Fixes) -> Fixes:
    middle = fixes.stamp_ns[len(fixes) // 3]
    is_within = (fixes.stamp_ns >= middle) & (fixes.stamp_ns < middle + round(1e9 * JUMP_S))
    return _moved(fixes, np.outer(is_within, [JUMP_M / np.sqrt(2.0), JUMP_M / np.sqrt(2.0), 0.0]))


def _without_third(fixes: Fixes, third: int) -> Fixes:
    kept = np.arange(len(fixes)) * 3 // len(fixes) != third
    return replace(
        fixes,
        stamp_ns=fixes.stamp_ns[kept],
        places=fixes.places[kept],
        sigma_m=fixes.sigma_m[kept],
        reasons=tuple(np.array(fixes.reasons)[kept].tolist()),
    )


def _with_residuals(fixes: Fixes, pos: Path, truth: Path) -> Fixes:
    """The errors of another receiver, in the order of time, one for each fix."""
    measured = read_fixes(pos)
    rows = [line.split() for line in truth.read_text().splitlines() if line[:1].isdigit()]
    true = np.array([[float(value) for value in row[:10]] for row in rows])
    degrees = [true[:, column] + true[:, column + 1] / 60.0 + true[:, column + 2] / 3600.0 for column in (3, 6)]
    places = np.column_stack([*degrees, true[:, 9]])
    usable = np.flatnonzero(measured.usable)
    same = np.searchsorted(true[:, 0], 1e-9 * measured.stamp_ns[usable]).clip(0, len(true) - 1)
    origin = Origin(*map(float, places[0]))
    off = enu_from_geodetic(measured.places[usable], origin) - enu_from_geodetic(places[same], origin)
    return _moved(fixes, np.resize(off, (len(fixes), 3)))


if __name__ == "__main__":
    main()
