"""`segslam simulate` and `demo`: drives through a simulated street."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from segslam.cli.checks import check_own, make_folder
from segslam.cli.completion import simulation_settings
from segslam.cli.console import Terminal, how_to_go_on
from segslam.cli.map import map_data
from segslam.cli.options import GnssOptions, OverwriteOption, RunOptions, RunOutput, set_option
from segslam.core.errors import SegslamError, counted
from segslam.core.interrupts import interrupts_wait, same_command_with, when_stopped

SEQUENCE = "00"
SEED = 33
SENSOR = "vlp16"
"""Chosen: simulating and mapping 16 beams takes a quarter of the time of 64."""
SCALE = 1.6
"""Chosen: a closed loop of 600 m."""
AXIS_WANDER_DEG, AXIS_WANDER_S = 0.35, 300.0
"""Chosen: four times the simulator's default and nearly constant over the drive. The odometry drifts visibly, but all
scans have the same distortion, so they still match."""


def simulate(
    out: Annotated[Path, "Folder to write, in KITTI's layout: sequences/NN/..., poses/NN.txt."],
    *,
    sequence: Annotated[str, "Name of the sequence to write."] = "00",
    poses: Annotated[
        Path | None, "KITTI pose file (camera frame) to drive along, levelled; default: a generated loop of streets."
    ] = None,
    frames: Annotated[int | None, typer.Option(min=1, help="Number of scans; default: the whole drive.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Random seed; the same seed gives the same scans.")] = 0,
    sensor: Annotated[Literal["hdl64", "os1-64", "vlp16"], "Sensor; hdl64 is that of KITTI."] = "hdl64",
    lane: Annotated[
        float, typer.Option(min=-4, max=4, help="Offset to the left of the path (m); negative: to the right.")
    ] = 0.0,
    reverse: Annotated[bool, "Drive the path in the opposite direction."] = False,
    settings: Annotated[
        list[str] | None,
        set_option(
            "Change a setting of the world or the sensor, for example world.cars=3.", completed=simulation_settings
        ),
    ] = None,
    pairs: Annotated[list[Path] | None, "Write only the scans in this list of pairs; may be repeated."] = None,
    sample: Annotated[
        int | None, typer.Option(min=1, help="Use only N pairs of each list, those of `bench --sample N --seed 0`.")
    ] = None,
    overwrite: OverwriteOption = False,
    terminal: Terminal,
) -> None:
    """Simulate a labelled drive in KITTI's format, with exact poses.

    Another day in the same streets has the same --seed and --set world.day=1; its true poses are in the same frame.

    Example: segslam simulate streets --sequence 06 --poses kitti/poses/06.txt --frames 300 --seed 1
    """
    if sample is not None and not pairs:
        raise SegslamError(f"--sample {sample}: only for lists of pairs; give them with --pairs")
    check_own(out, "sequences", "poses")
    terminal.announce(f"simulate: making a drive in {out}")
    from segslam.bench.simulation.files import prepare_folder, write_drive
    from segslam.bench.simulation.tracks import example_drive, in_lane, read_drive
    from segslam.bench.simulation.world_settings import simulation_config

    config = simulation_config(sensor, settings or ())
    drive = example_drive(frames or 0) if poses is None else read_drive(poses, sequence=sequence)
    driven = in_lane(drive, left_m=lane, reverse=reverse)
    total = min(frames or len(drive.time_s), len(drive.time_s))
    only = _named(pairs, total, sample=sample) if pairs else None
    total = len(only) if only is not None else total
    prepare_folder(out, sequence, overwrite=overwrite)
    terminal.say(f"building the world for {counted(total, 'scan')}")
    written = write_drive(out, sequence, drive, config=config, seed=seed, driven=driven, num_frames=frames, only=only)
    last = 0
    begin_again = f"to start again: {same_command_with('--overwrite')}"
    try:
        with how_to_go_on(begin_again, out), interrupts_wait() as interrupts:
            for done in terminal.progress(written, total, "simulate"):
                last = done
                if interrupts:
                    break
    except KeyboardInterrupt:
        are_complete = f"{counted(last, 'scan')} {'is' if last == 1 else 'are'} complete"
        when_stopped(f"{are_complete} in {out / 'sequences' / sequence}; {begin_again}")
        raise
    folder, true_poses = out / "sequences" / sequence, out / "poses" / f"{sequence}.txt"
    figures = {"num_scans": last, "sequence": str(folder), "poses": str(true_poses)}
    terminal.answer(figures, f"{counted(last, 'scan')} in {folder}, true poses in {true_poses}")


def demo(
    *,
    out: Annotated[Path, "New folder for the data and the run."] = Path("segslam-demo"),
    overwrite: OverwriteOption = False,
    terminal: Terminal,
) -> None:
    """Simulate a street drive whose odometry drifts, map it, and draw the map before and after loop closing.

    Example: segslam demo --out runs/demo
    """
    terminal.announce(f"demo: simulating a drive in {out}")
    from segslam.bench.simulation.files import SETTINGS_FILE, prepare_folder, write_drive
    from segslam.bench.simulation.tracks import example_drive
    from segslam.bench.simulation.world_settings import SensorConfig, SimulationConfig
    from segslam.core.whole_files import write_whole
    from segslam.output.report import BEFORE_AFTER, draw_before_after

    made_by = (f"data/sequences/{SEQUENCE}/{SETTINGS_FILE}",)
    data = make_folder(out, overwrite=overwrite, made_by=made_by) / "data"
    begin_again = f"to start again: {same_command_with('--overwrite')}"
    when_stopped(begin_again)
    sensor = SensorConfig(name=SENSOR, axis_wander_sigma_deg=AXIS_WANDER_DEG, axis_wander_s=AXIS_WANDER_S)
    drive = example_drive(scale=SCALE)
    prepare_folder(data, SEQUENCE, overwrite=False)
    config = SimulationConfig(sensor=sensor)
    written = write_drive(data, SEQUENCE, drive, config=config, seed=SEED)
    with how_to_go_on(begin_again, out):
        for _ in terminal.progress(written, len(drive.time_s), "simulate"):
            pass
    options = RunOptions(labels="geometric", preset="driving")
    map_data(data, out / "run", options, RunOutput(), terminal, GnssOptions(), go_on=begin_again)
    picture = out / "run" / BEFORE_AFTER
    write_whole(picture, draw_before_after(out / "run"))
    terminal.say(f"map before and after loop closing: {picture}")


def _named(files: list[Path], num_scans: int, *, sample: int | None) -> set[int]:
    """Numbers of the scans in the lists. Raises SegslamError for a scan that the drive does not have."""
    from segslam.bench.experiments.pairs import read_pairs, sample_pairs, scans_named

    only = scans_named([sample_pairs(read_pairs(file), num_pairs=sample, seed=0) for file in files])
    if max(only) >= num_scans:
        raise SegslamError(
            f"--pairs: the list contains scan {max(only)}, but the drive has {num_scans}; use the list of this drive"
        )
    return only
