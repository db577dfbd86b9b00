"""`segslam simulate`."""

from pathlib import Path
from typing import Annotated

import typer

from segslam.cli.console import JsonOption, QuietOption, print_json, progress, say
from segslam.interrupts import interrupts_wait


def simulate(
    out: Annotated[Path, typer.Argument(help="Folder to write; it becomes KITTI's: sequences/NN/..., poses/NN.txt.")],
    sequence: Annotated[str, typer.Option(help="Name of the sequence to write.")] = "00",
    poses: Annotated[
        Path | None,
        typer.Option(help="Drive along this KITTI pose file (camera frame), levelled; else a made-up loop of streets."),
    ] = None,
    frames: Annotated[int | None, typer.Option(min=1, help="Number of scans; all of the drive unless given.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="The same seed gives the same scans.")] = 0,
    sensor: Annotated[str, typer.Option(help="hdl64 (KITTI's), os1-64 or vlp16.")] = "hdl64",
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="SECTION.KEY=VALUE", help="Change the world or the sensor, as in world.cars=3."),
    ] = None,
    pairs: Annotated[
        list[Path] | None,
        typer.Option("--pairs", help="Write only the scans that this list of pairs names; may be repeated."),
    ] = None,
    sample: Annotated[
        int | None, typer.Option(min=1, help="Of so many pairs of each list: those of bench's --sample with --seed 0.")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a sequence that was simulated here.")] = False,
    json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Simulate a labelled drive in KITTI's format, with exact poses.

    Example: segslam simulate streets --sequence 06 --poses kitti/poses/06.txt --frames 300 --seed 1
    """
    from segslam import simulation

    config = simulation.simulation_config(sensor, settings or ())
    drive = simulation.made_up_drive(frames or 0) if poses is None else simulation.read_drive(poses, sequence=sequence)
    total = min(frames or len(drive.time_s), len(drive.time_s))
    only = _named(pairs, total, sample=sample) if pairs else None
    total = len(only) if only is not None else total
    simulation.prepare_folder(out, sequence, overwrite=overwrite)
    say(f"building the streets of {total} scans", quiet=quiet)
    written = simulation.write_drive(out, sequence, drive, config=config, seed=seed, num_frames=frames, only=only)
    last = 0
    try:
        with interrupts_wait() as interrupts:
            for done in progress(written, total=total, title="simulate", quiet=quiet):
                last = done
                if interrupts:
                    break
    except KeyboardInterrupt:
        say(f"stopped: {last} scans are complete in {out / 'sequences' / sequence}", quiet=quiet)
        raise typer.Exit(130) from None
    folder, true_poses = out / "sequences" / sequence, out / "poses" / f"{sequence}.txt"
    if json:
        print_json({"num_scans": last, "sequence": str(folder), "poses": str(true_poses)})
    else:
        say(f"{last} scans in {folder}, true poses in {true_poses}", quiet=quiet)


def _named(files: list[Path], num_scans: int, *, sample: int | None) -> set[int]:
    """The scans that the lists name. Raises SegslamError for one that the drive does not have."""
    from segslam.experiments.pairs import read_pairs, sample_pairs, scans_named
    from segslam.types import SegslamError

    lists = [read_pairs(file) for file in files]
    only = scans_named(lists if sample is None else [sample_pairs(one, num_pairs=sample, seed=0) for one in lists])
    if max(only) >= num_scans:
        raise SegslamError(
            f"--pairs: scan {max(only)} is named, the drive has {num_scans}; take the list of this drive"
        )
    return only
