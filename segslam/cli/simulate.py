"""`segslam simulate`."""

from pathlib import Path
from typing import Annotated

import typer

from segslam.cli.completion import SENSORS, one_of, simulation_settings
from segslam.cli.console import JsonOption, QuietOption, announce, print_json, progress, say
from segslam.core.errors import WorkFailed
from segslam.core.interrupts import EXIT_STATUS, interrupts_wait, same_command_with, when_stopped


def simulate(
    out: Annotated[Path, typer.Argument(help="Folder to write, in KITTI's layout: sequences/NN/..., poses/NN.txt.")],
    sequence: Annotated[str, typer.Option(help="Name of the sequence to write.")] = "00",
    poses: Annotated[
        Path | None,
        typer.Option(
            help="KITTI pose file (camera frame) to drive along, levelled; default: a generated loop of streets."
        ),
    ] = None,
    frames: Annotated[int | None, typer.Option(min=1, help="Number of scans; default: the whole drive.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Random seed; the same seed gives the same scans.")] = 0,
    sensor: Annotated[
        str, typer.Option(autocompletion=one_of(*SENSORS), help="Sensor: hdl64 (as in KITTI), os1-64 or vlp16.")
    ] = "hdl64",
    lane: Annotated[
        float, typer.Option(min=-4, max=4, help="Offset to the left of the path (m); negative: to the right.")
    ] = 0.0,
    reverse: Annotated[bool, typer.Option("--reverse", help="Drive the path in the opposite direction.")] = False,
    settings: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="SECTION.KEY=VALUE",
            autocompletion=simulation_settings,
            help="Change a setting of the world or the sensor, for example world.cars=3.",
        ),
    ] = None,
    pairs: Annotated[
        list[Path] | None,
        typer.Option("--pairs", help="Write only the scans in this list of pairs; may be repeated."),
    ] = None,
    sample: Annotated[
        int | None, typer.Option(min=1, help="Use only N pairs of each list, those of `bench --sample N --seed 0`.")
    ] = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace an earlier simulated sequence in this folder.")
    ] = False,
    json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Simulate a labelled drive in KITTI's format, with exact poses.

    Another day in the same streets has the same --seed and --set world.day=1; its true poses are in the same frame.

    Example: segslam simulate streets --sequence 06 --poses kitti/poses/06.txt --frames 300 --seed 1
    """
    announce(f"simulate: making a drive in {out}", quiet=quiet)
    from segslam.bench import simulation

    config = simulation.simulation_config(sensor, settings or ())
    drive = simulation.example_drive(frames or 0) if poses is None else simulation.read_drive(poses, sequence=sequence)
    driven = simulation.in_lane(drive, left_m=lane, reverse=reverse)
    total = min(frames or len(drive.time_s), len(drive.time_s))
    only = _named(pairs, total, sample=sample) if pairs else None
    total = len(only) if only is not None else total
    simulation.prepare_folder(out, sequence, overwrite=overwrite)
    say(f"building the world for {total} scans", quiet=quiet)
    written = simulation.write_drive(
        out, sequence, drive, config=config, seed=seed, driven=driven, num_frames=frames, only=only
    )
    last = 0
    begin_again = f"to start again: {same_command_with('--overwrite')}"
    try:
        with interrupts_wait() as interrupts:
            for done in progress(written, total=total, title="simulate", quiet=quiet):
                last = done
                if interrupts:
                    break
    except KeyboardInterrupt:
        when_stopped(f"{last} scans are complete in {out / 'sequences' / sequence}; {begin_again}")
        raise typer.Exit(EXIT_STATUS) from None
    except WorkFailed as error:
        raise WorkFailed(f"{error}; {begin_again}") from error
    folder, true_poses = out / "sequences" / sequence, out / "poses" / f"{sequence}.txt"
    if json:
        print_json({"num_scans": last, "sequence": str(folder), "poses": str(true_poses)})
    else:
        say(f"{last} scans in {folder}, true poses in {true_poses}", quiet=quiet)


def _named(files: list[Path], num_scans: int, *, sample: int | None) -> set[int]:
    """Numbers of the scans in the lists. Raises SegslamError for a scan that the drive does not have."""
    from segslam.bench.experiments.pairs import read_pairs, sample_pairs, scans_named
    from segslam.core.types import SegslamError

    lists = [read_pairs(file) for file in files]
    only = scans_named(lists if sample is None else [sample_pairs(one, num_pairs=sample, seed=0) for one in lists])
    if max(only) >= num_scans:
        raise SegslamError(
            f"--pairs: the list contains scan {max(only)}, but the drive has {num_scans}; use the list of this drive"
        )
    return only
