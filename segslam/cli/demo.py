"""`segslam demo`."""

from pathlib import Path
from typing import Annotated

import typer

from segslam.cli.console import JsonOption, QuietOption, announce, progress, say
from segslam.cli.map import map_scans
from segslam.cli.overwriting import OverwriteOption, make_room
from segslam.core.errors import WorkFailed
from segslam.core.interrupts import same_command_with, when_stopped

SEQUENCE = "00"
SEED = 33
SENSOR = "vlp16"
"""Chosen: simulating and mapping 16 beams takes a quarter of the time of 64."""
SCALE = 1.6
"""Chosen: a closed loop of 600 m."""
AXIS_WANDER_DEG, AXIS_WANDER_S = 0.35, 300.0
"""Chosen: four times the simulator's default and nearly constant over the drive. The odometry drifts visibly, but all
scans have the same distortion, so they still match."""


def demo(
    out: Annotated[Path, typer.Option(help="New folder for the data and the run.")] = Path("segslam-demo"),
    overwrite: OverwriteOption = False,
    json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Simulate a street drive whose odometry drifts, map it, and draw the map before and after loop closing.

    Example: segslam demo --out runs/demo
    """
    announce(f"demo: simulating a drive in {out}", quiet=quiet)
    from segslam.bench import simulation
    from segslam.bench.simulation.files import SETTINGS_FILE
    from segslam.core.config import Config
    from segslam.output.folder import new_folder
    from segslam.output.report import BEFORE_AFTER, write_before_after
    from segslam.scans import open_dataset

    make_room(out, overwrite=overwrite, made_by=(f"data/sequences/{SEQUENCE}/{SETTINGS_FILE}",))
    data = new_folder(out) / "data"
    begin_again = f"to start again: {same_command_with('--overwrite')}"
    when_stopped(begin_again)
    sensor = simulation.SensorConfig(name=SENSOR, axis_wander_sigma_deg=AXIS_WANDER_DEG, axis_wander_s=AXIS_WANDER_S)
    drive = simulation.example_drive(scale=SCALE)
    simulation.prepare_folder(data, SEQUENCE, overwrite=False)
    config = simulation.SimulationConfig(sensor=sensor)
    written = simulation.write_drive(data, SEQUENCE, drive, config=config, seed=SEED)
    try:
        for _ in progress(written, total=len(drive.time_s), title="simulate", quiet=quiet):
            pass
    except WorkFailed as error:
        raise WorkFailed(f"{error}; {begin_again}") from error
    scans = open_dataset(data, sequence=SEQUENCE, labels="geometric")
    map_scans(scans, out / "run", settings=Config(), go_on=begin_again, json=json, quiet=quiet)
    picture = write_before_after(out / "run", out / "run" / BEFORE_AFTER)
    say(f"map before and after loop closing: {picture}\nreport: {out / 'run' / 'report.html'}", quiet=quiet)
