"""`segslam eval`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from segslam.cli.console import JsonOption, QuietOption, print_json, say

if TYPE_CHECKING:
    from segslam.trajectory import PoseFile
    from segslam.types import IndexPairs

UP = {"z": (0.0, 0.0, 1.0), "-y": (0.0, -1.0, 0.0)}


def evaluate(
    run: Annotated[Path | None, typer.Argument(help="Run folder; its metrics.json takes the new figures up.")] = None,
    reference: Annotated[Path | None, typer.Option(help="True poses, KITTI or TUM format.")] = None,
    estimate: Annotated[Path | None, typer.Option(help="Estimated poses, in place of a run.")] = None,
    format: Annotated[
        Literal["kitti", "tum"] | None, typer.Option(help="Of both files; else told by the columns.")
    ] = None,
    up: Annotated[
        Literal["z", "-y"] | None,
        typer.Option(help="Upwards in the reference's frame; else -y (camera) in KITTI's format and z in TUM's."),
    ] = None,
    max_difference: Annotated[float, typer.Option(help="Farthest that stamps of one pose are apart (s).")] = 0.01,
    json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Score a run, or a trajectory, against the truth.

    Example: segslam eval runs/00; or segslam eval --estimate poses_kitti.txt --reference kitti/poses/00.txt
    """
    from segslam.types import SegslamError

    if run is not None and estimate is None:
        figures = _score_run(run, reference)
    elif run is None and estimate is not None and reference is not None:
        figures = _score_files(estimate, reference, format, up, max_difference, quiet=quiet)
    else:
        raise SegslamError("name either a run folder, or two files by --estimate and --reference")
    if json:
        print_json(figures)
    elif not quiet:
        print(table(figures))


def table(figures: dict[str, Any]) -> str:
    """The figures with what they mean, a line each."""
    from segslam.results import FIGURES

    return "\n".join(f"{figures[key]:10.4g}  {meaning}" for key, meaning in FIGURES.items() if key in figures)


def _score_run(folder: Path, reference_file: Path | None) -> dict[str, Any]:
    from segslam.results import read_run, true_poses
    from segslam.run_files import write_metrics
    from segslam.runs import accuracy
    from segslam.types import SegslamError

    run = read_run(folder)
    reference = run.reference if reference_file is None else true_poses(reference_file, run)
    if reference is None:
        raise SegslamError(f"{folder}: its data had no true poses; name a file of them by --reference")
    metrics = run.metrics | accuracy(run.result, reference)
    write_metrics(folder, metrics)
    return metrics


def _score_files(
    estimate_file: Path,
    reference_file: Path,
    format: Literal["kitti", "tum"] | None,
    up: str | None,
    max_difference_s: float,
    *,
    quiet: bool,
) -> dict[str, Any]:
    from segslam.evaluation import trajectory_metrics
    from segslam.trajectory import read_poses
    from segslam.types import SegslamError

    estimate, reference = (read_poses(file, format=format) for file in (estimate_file, reference_file))
    if (estimate.stamp_ns is None) != (reference.stamp_ns is None):
        raise SegslamError(f"{estimate_file}: not of the format of {reference_file}; rows cannot be told from stamps")
    rows = _matching_rows(estimate, reference, round(max_difference_s * 1e9))
    direction = up or ("-y" if estimate.stamp_ns is None else "z")
    figures = trajectory_metrics(estimate.T_a_b[rows[:, 0]], reference.T_a_b[rows[:, 1]], up=UP[direction])
    if not figures:
        raise SegslamError(
            f"{estimate_file}: {len(rows)} of its {len(estimate)} poses are among the {len(reference)} of "
            f"{reference_file}; three are needed. Check the files, or --max-difference for stamps"
        )
    if not len(rows) == len(estimate) == len(reference):
        say(f"scored {len(rows)} poses of {len(estimate)} estimated and {len(reference)} true ones", quiet=quiet)
    return figures | {"num_poses": len(rows)}


def _matching_rows(estimate: "PoseFile", reference: "PoseFile", max_difference_ns: int) -> "IndexPairs":
    """Row by row in KITTI's format, where rows are scans; by stamp in TUM's."""
    import numpy as np

    from segslam.trajectory import rows_of_same_stamp

    if estimate.stamp_ns is None or reference.stamp_ns is None:
        common = np.arange(min(len(estimate), len(reference)))
        return np.column_stack([common, common])
    return rows_of_same_stamp(estimate.stamp_ns, reference.stamp_ns, max_difference_ns=max_difference_ns)
