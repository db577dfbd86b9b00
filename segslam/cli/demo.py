"""`segslam demo`."""

from pathlib import Path
from typing import Annotated

import typer

from segslam.cli.console import JsonOption, QuietOption, progress, say
from segslam.cli.map import map_scans

SEQUENCE = "00"
SEED = 2
AXIS_WANDER_DEG = 0.5
"""Six times the simulator's default, so that a drive of 280 m drifts enough to be seen."""


def demo(
    out: Annotated[Path, typer.Option(help="New folder for the data and the run.")] = Path("segslam-demo"),
    json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Simulate a small street sequence, map it, evaluate it, draw it: no data needed.

    Example: segslam demo --out runs/demo
    """
    from segslam import simulation
    from segslam.config import Config
    from segslam.datasets import open_dataset
    from segslam.report import draw_picture
    from segslam.run_files import new_folder

    data = new_folder(out) / "data"
    config = simulation.SimulationConfig(sensor=simulation.SensorConfig(axis_wander_sigma_deg=AXIS_WANDER_DEG))
    drive = simulation.made_up_drive()
    simulation.prepare_folder(data, SEQUENCE, overwrite=False)
    written = simulation.write_drive(data, SEQUENCE, drive, config=config, seed=SEED)
    for _ in progress(written, total=len(drive.time_s), title="simulate", quiet=quiet):
        pass
    scans = open_dataset(data, sequence=SEQUENCE, labels="geometric")
    map_scans(scans, out / "run", settings=Config(), json=json, quiet=quiet)
    say(f"picture in {draw_picture(out / 'run')}", quiet=quiet)
