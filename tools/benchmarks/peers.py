"""Whole sequences by segslam and by kiss-slam, on the same scans: errors against the truth, closures, time.

kiss-slam requires NumPy below 2.3, so it needs a separate environment:

    python -m venv peers && peers/bin/pip install kiss-slam==0.0.2 pillow matplotlib
    segslam simulate D --sequence 06 --poses 06.txt --seed 11
    python -m tools.benchmarks.peers D --sequence 06 --kiss-slam peers/bin/kiss_slam_pipeline --work R --out F.json
    python -m tools.benchmarks.peers SCANS --kiss-slam peers/bin/kiss_slam_pipeline --work R --out F.json

SCANS is a folder of scans with poses.txt; kiss-slam reads the scans alone.
Results of an earlier call in the folder `--work` are reused.
"""

import json
import os
import re
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from segslam.core.evaluation import trajectory_metrics
from segslam.core.trajectory import lidar_from_camera
from segslam.output.finished import FinishedRun, read_run
from tools.benchmarks import common

FIGURES = ("ate_m", "height_m", "kitti_translation_percent")
OWN_FIGURES = (*FIGURES, "odometry_ate_m", "num_loops_accepted", "num_loops_false", "loop_recall", "seconds_total")
CLOSURES = re.compile(r"Number of closures found\D+(\d+)")


def own(data: Path, sequence: str | None, run: Path) -> tuple[dict[str, Any], FinishedRun]:
    """Figures of segslam with its defaults, and the run. Raises CalledProcessError if it fails."""
    if not (run / "metrics.json").is_file():
        which = ["--sequence", sequence] if sequence else []
        command = [sys.executable, "-m", "segslam", "map", str(data), *which, "--out", str(run)]
        subprocess.run(command, check=True)
    finished = read_run(run)
    return {name: finished.metrics.get(name) for name in OWN_FIGURES}, finished


def kiss_slam(data: Path, sequence: str | None, program: Path, folder: Path, run: FinishedRun) -> dict[str, Any]:
    """Figures of kiss-slam with its defaults on the scans of `run`. Raises CalledProcessError if it fails."""
    if run.reference is None or (sequence and run.T_camera_lidar is None):
        sys.exit(f"{data}: has no true poses or no calibration; name one that has both")
    folder.mkdir(parents=True, exist_ok=True)
    printed = folder / "printed.txt"
    if not printed.is_file():
        started = time.perf_counter()
        environment = {**os.environ, "KISS_SLAM_OUT_DIR": str(folder), "MPLBACKEND": "Agg"}
        which = ["--dataloader", "kitti", "--sequence", sequence] if sequence else ["--dataloader", "generic"]
        scans = data / "velodyne" if (data / "velodyne").is_dir() else data
        command = [str(program.absolute()), *which, str(scans.absolute())]
        done = subprocess.run(command, check=True, cwd=folder, env=environment, capture_output=True, text=True)
        printed.write_text(f"{done.stdout}\nseconds {time.perf_counter() - started:.1f}\n", encoding="utf-8")
    text = printed.read_text(encoding="utf-8")
    poses = np.load(next((folder / "latest").glob("*_poses.npy")))
    if run.T_camera_lidar is not None:
        poses = lidar_from_camera(poses, run.T_camera_lidar)
    metrics = trajectory_metrics(poses[run.reference.scan_index], run.reference.T_world_lidar)
    closures = CLOSURES.search(text)
    return {
        **{name: metrics.get(name) for name in FIGURES},
        "num_loops_accepted": int(closures[1]) if closures else None,
        "seconds_total": float(text.rsplit("seconds", 1)[1]),
    }


def main() -> None:
    parser = common.parser(__doc__, "peers")
    parser.add_argument("data", type=Path, help="folder with sequences/ and poses/, or of scans with poses.txt")
    parser.add_argument("--sequence", help="for a folder with sequences/")
    parser.add_argument("--kiss-slam", type=Path, required=True, help="its program kiss_slam_pipeline")
    parser.add_argument("--work", type=Path, required=True, help="folder for the runs")
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    options = parser.parse_args()
    name = options.sequence or options.data.resolve().name
    ours, run = own(options.data, options.sequence, options.work / f"segslam_{name}")
    folder = options.work / f"kiss_slam_{name}"
    theirs = kiss_slam(options.data, options.sequence, options.kiss_slam, folder, run)
    result = {"sequence": name, "segslam": ours, "kiss-slam": theirs}
    print(json.dumps(result, indent=1))
    common.write_report(options.out, result)


if __name__ == "__main__":
    main()
