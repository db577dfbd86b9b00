"""Motions that differ from the true ones by more than their covariance: is the pose wrong, or the truth?

    python -m tools.benchmarks.motions SCANS RUN [--out motions.json]

Each motion of a run outside the ellipsoid of 99 % of its covariance is measured once more, by another program and
without a local map: GICP of small_gicp between the two scans, which starts at the true motion. It is compared with the
motion of the run and with the true one, by the same ellipsoid.
"""

from pathlib import Path

import numpy as np
import small_gicp
from scipy.stats import chi2

from segslam.core.types import Points, SegslamError, Transform
from segslam.output.finished import read_run
from segslam.scans import open_dataset
from tools.benchmarks import common
from tools.benchmarks.real import compared_motions

VOXEL_M, REACH_M = 0.5, 1.0
"""Chosen, of GICP: edge of the voxels of both scans, and search distance; true motions are off by up to 1 m."""
MOST_OFF = float(chi2.ppf(0.99, 6))


def registered(target: Points, source: Points, T_target_guess: Transform) -> Transform:
    """T_target_source by GICP from an initial guess."""
    found = small_gicp.align(
        *(target.astype(np.float64), source.astype(np.float64), T_target_guess),
        registration_type="GICP",
        downsampling_resolution=VOXEL_M,
        max_correspondence_distance=REACH_M,
        num_threads=1,
    )
    return np.asarray(found.T_target_source)


def main() -> None:
    parser = common.parser(__doc__, "motions")
    parser.add_argument("scans", type=Path)
    parser.add_argument("run", type=Path)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    run, scans = read_run(options.run), open_dataset(options.scans)
    if run.reference is None:
        raise SegslamError(f"{options.run}: the run has no true poses; map a folder with poses.txt")
    motions, row_of = compared_motions(run), {int(index): row for row, index in enumerate(scans.scan_index)}
    outside = [motion for motion in motions if motion.off(motion.T_true, motion.T_found) >= MOST_OFF]
    near_run, near_truth = np.zeros(len(outside), bool), np.zeros(len(outside), bool)
    for number, motion in enumerate(outside):
        target, source = (scans[row_of[index]].points for index in motion.scans)
        T_again = registered(target, source, motion.T_true)
        near_run[number] = motion.off(motion.T_found, T_again) < MOST_OFF
        near_truth[number] = motion.off(motion.T_true, T_again) < MOST_OFF
    figures: common.Row = {
        "run": options.run.name,
        "motions": len(motions),
        "outside": len(outside),
        "measured_again_as_in_the_run": int(near_run.sum()),
        "as_the_true_one": int(near_truth.sum()),
        "as_neither": int((~near_run & ~near_truth).sum()),
    }
    print(common.markdown("Motions outside the ellipsoid", [figures]))
    if options.out:
        common.write_report(options.out, figures)


if __name__ == "__main__":
    main()
