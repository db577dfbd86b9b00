"""`segslam demo`."""

from pathlib import Path
from typing import Annotated

import typer

from segslam.cli.console import JsonOption, QuietOption, progress, say
from segslam.cli.map import map_scans

SEQUENCE = "00"


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
    from segslam.report import draw_picture, write_report
    from segslam.run_files import new_folder

    data = new_folder(out) / "data"
    drive = simulation.made_up_drive()
    simulation.prepare_folder(data, SEQUENCE, overwrite=False)
    written = simulation.write_drive(data, SEQUENCE, drive, config=simulation.SimulationConfig(), seed=0)
    for _ in progress(written, total=len(drive.time_s), title="simulate", quiet=quiet):
        pass
    scans = open_dataset(data, sequence=SEQUENCE, labels="geometric")
    map_scans(scans, out / "run", settings=Config(), json=json, quiet=quiet)
    say(f"picture {draw_picture(out / 'run')}, report {write_report(out / 'run')}", quiet=quiet)
