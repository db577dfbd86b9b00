"""`segslam eval`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from segslam.cli.checks import check_free, check_links
from segslam.cli.console import Terminal
from segslam.cli.options import MOST_OFFSET_S, OverwriteOption
from segslam.cli.tables import TableFiles, as_text, with_meanings
from segslam.core.errors import SegslamError


@dataclass(frozen=True)
class Scoring:
    """How poses are read, matched and aligned."""

    format: Annotated[
        Literal["kitti", "tum"] | None, "Format of the files; detected from the number of columns by default."
    ] = None
    up: Annotated[
        Literal["z", "-y"] | None, "Upward axis of the two files: z, or -y for cameras; by default found from the path."
    ] = None
    max_difference: Annotated[
        float,
        typer.Option(min=0, max=MOST_OFFSET_S, help="Largest time difference between a pose and its reference (s)."),
    ] = 0.01
    align: Annotated[
        Literal["se3", "sim3", "first", "none"],
        "Alignment: rigid (se3), with scale (sim3), of the first pose (first), or none.",
    ] = "se3"
    rpe_distance: Annotated[
        float | None,
        typer.Option(min=0.01, metavar="METRES", help="Also measure the error of the motion over this distance."),
    ] = None


def evaluate(
    run: Annotated[Path | None, "Run folder; its metrics.json is updated with the new figures."] = None,
    *,
    reference: Annotated[Path | None, "Ground-truth poses, KITTI or TUM format; a folder if --estimate is one."] = None,
    estimate: Annotated[Path | None, "Estimated poses, or a folder with poses NAME.txt of several drives."] = None,
    how: Scoring,
    tables: TableFiles,
    plot: Annotated[Path | None, "Draw both trajectories and the error to this file: .png, .svg or .pdf."] = None,
    overwrite: OverwriteOption = False,
    terminal: Terminal,
) -> None:
    """Measure the error of a run, or of a trajectory, against ground truth.

    Two folders are compared drive by drive: all of KITTI 00 to 10 in one command. metrics.json of a run keeps the
    figures of --align se3.

    Example: segslam eval runs/00; or segslam eval --estimate poses_kitti.txt --reference kitti/poses/00.txt; or
    segslam eval --estimate runs --reference kitti/poses --csv kitti.csv
    """
    check_free([plot, tables.csv, tables.latex], overwrite=overwrite, inputs=[estimate, reference])
    if plot is not None:
        from segslam.output.report.comparison import check_picture

        check_picture(plot)
    if run is not None or estimate is not None:
        terminal.announce(f"eval: reading {run or estimate}")
    to_keep: dict[str, Any] = {}
    if run is not None and estimate is None:
        figures, to_keep = _score_run(run, reference, how, plot, terminal)
        rows = {run.resolve().name: figures}
    elif run is None and estimate is not None and reference is not None:
        if estimate.is_dir():
            if plot is not None:
                raise SegslamError("--plot: draws one drive; give two files")
            rows = _score_folders(estimate, reference, how)
            axes = ", ".join(sorted({str(row["up"]) for row in rows.values() if "up" in row}))
            terminal.say(f"{reference}: upward axis {axes}" + ("" if how.up else "; for another: --up"))
            figures = {"drives": rows}
        else:
            figures = _score_files(estimate, reference, how, plot, terminal)
            rows = {estimate.stem: figures}
    else:
        raise SegslamError("give either a run folder, or two files with --estimate and --reference")
    if how.rpe_distance is not None and not any("rpe_distance_m" in row for row in rows.values()):
        terminal.say(f"--rpe-distance {how.rpe_distance:g}: no drive is that long; the error over it is not given")
    tables.write(rows)
    from segslam.output.accuracy import AFTER
    from segslam.output.folder import folder_of, write_metrics
    from segslam.output.words import FIGURES, SCORES

    meanings = {"ate_m": FIGURES["ate_m"]} | SCORES | FIGURES
    meanings = {key: words.replace(AFTER["se3"], AFTER[how.align]) for key, words in meanings.items()}
    terminal.table(figures, as_text(rows) if "drives" in figures else with_meanings([figures], meanings))
    if plot is not None and not terminal.json:
        terminal.say(f"figure written to {plot}")
    if run is not None and to_keep:  # at the end: the figures are shown also if the folder cannot be written
        write_metrics(folder_of(run), to_keep)


def _score_run(
    folder: Path, reference_file: Path | None, how: Scoring, plot: Path | None, terminal: Terminal
) -> tuple[dict[str, Any], dict[str, Any]]:
    """The figures, and those that metrics.json keeps."""
    from segslam.output.accuracy import accuracy, scores
    from segslam.output.finished import ACCURACY, plain_name, read_run, true_poses
    from segslam.output.folder import folder_of
    from segslam.run.evaluate import matched_poses

    if how.up == "-y":
        raise SegslamError("--up -y: only for two files, because the poses of a run have z up; omit the option")
    if reference_file is None and (how.format or how.max_difference != Scoring.max_difference):
        raise SegslamError("--format, --max-difference: only for poses of a file; give one with --reference")
    folder = folder_of(folder)
    check_links(folder)
    run = read_run(folder)
    reference = run.reference
    if reference_file is not None:
        limit_ns = round(how.max_difference * 1e9)
        reference = true_poses(reference_file, run, format=how.format, max_difference_ns=limit_ns)
    if reference is None:
        raise SegslamError(f"{folder}: the data has no ground-truth poses; give a file with --reference")
    figures = accuracy(run.result, reference, align=how.align)
    num_scans = len(run.result.trajectory)
    if "ate_m" not in figures:
        raise SegslamError(
            f"{reference_file or folder}: only {len(reference)} of {num_scans} scans have a pose; three are needed"
        )
    if len(reference) < num_scans:
        terminal.say(f"scored the {len(reference)} of {num_scans} scans that have a reference pose")
    metrics = {key: value for key, value in run.metrics.items() if plain_name(key) not in ACCURACY} | figures
    matched, truth = matched_poses(run.result.trajectory, reference)
    if plot is not None:
        from segslam.core.trajectory import begun_among, rows_of_same_scan
        from segslam.output.report.comparison import draw_scored

        rows = rows_of_same_scan(run.result.trajectory.scan_index, reference.scan_index)
        draw_scored(plot, matched, truth, align=how.align, begun=begun_among(rows[:, 0], run.result.begun))
    figures = scores(matched, truth, align=how.align, rpe_distance_m=how.rpe_distance) | metrics
    return figures, metrics if how.align == "se3" else {}


def _score_folders(estimates: Path, references: Path, how: Scoring) -> dict[str, dict[str, Any]]:
    """The figures of each drive by name, in order, then their means over the drives, called `mean`.

    A drive has a file `NAME.txt` in both folders, or `NAME/poses_kitti.txt` in the first, as run folders have. Raises
    SegslamError if no drive has both.
    """
    rows: dict[str, dict[str, Any]] = {}
    for true in sorted(references.glob("*.txt")):
        made = [file for file in (estimates / true.name, estimates / true.stem / "poses_kitti.txt") if file.is_file()]
        rows |= {true.stem: _score_files(made[0], true, how, None, Terminal(quiet=True))} if made else {}
    if not rows:
        raise SegslamError(
            f"{estimates}: no drive has poses here and in {references}; give both files one name, 00.txt, or the "
            "runs 00, 01, ..."
        )
    first, *others = rows.values()
    numeric = [key for key, value in first.items() if isinstance(value, float) and all(key in row for row in others)]
    mean = {key: sum(row[key] for row in rows.values()) / len(rows) for key in numeric}
    return rows | ({"mean": mean} if len(rows) > 1 else {})


def _score_files(
    estimate_file: Path, reference_file: Path, how: Scoring, plot: Path | None, terminal: Terminal
) -> dict[str, Any]:
    from segslam.core.evaluation import UP, upward_axis
    from segslam.core.pose_files import read_poses
    from segslam.output.accuracy import scores
    from segslam.run.evaluate import matched_poses

    estimate, reference = (read_poses(file, format=how.format) for file in (estimate_file, reference_file))
    if (estimate.stamp_ns is None) != (reference.stamp_ns is None):
        raise SegslamError(
            f"{estimate_file}: another format than {reference_file} (KITTI rows, TUM stamps); convert one of them"
        )
    if estimate.stamp_ns is None and len(estimate) != len(reference):
        raise SegslamError(
            f"{estimate_file}: {len(estimate)} poses, but {reference_file} has {len(reference)}; in KITTI format "
            "line n + 1 is scan n in both. Score the run folder instead, or use TUM format, which is matched by stamp"
        )
    matched, truth = matched_poses(estimate, reference, max_difference_ns=round(how.max_difference * 1e9))
    up, why = how.up, ""
    if up is None:
        up, why = upward_axis(truth), "the path is flattest along it"
        if up is None and estimate.stamp_ns is None:
            up, why = "-y", "as in KITTI's files; the path does not show it"
        elif up is None:
            up, why = "z", "the path does not show it"
    figures = scores(matched, truth, align=how.align, rpe_distance_m=how.rpe_distance, up=UP[up])
    if not figures:
        raise SegslamError(
            f"{estimate_file}: only {len(matched)} of its {len(estimate)} poses match one of the {len(reference)} "
            f"poses of {reference_file}; at least three are needed. Check the files, or raise --max-difference"
        )
    if why:
        terminal.say(f"{reference_file}: upward axis {up} ({why}); for another: --up")
    if plot is not None:
        from segslam.output.report.comparison import draw_scored

        draw_scored(plot, matched, truth, align=how.align, up=up)
    if not len(matched) == len(estimate) == len(reference):
        terminal.say(f"scored {len(matched)} poses; estimate {len(estimate)}, reference {len(reference)}")
    return figures | {"num_poses": len(matched), "up": up}
