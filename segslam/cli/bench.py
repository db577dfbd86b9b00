"""`segslam bench`: the experiments of the paper, with all methods on the same scans."""

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from segslam.cli.bench_options import (
    DataArgument,
    Options,
    make_job,
    read_lists,
    reference_of,
    run_trials,
)
from segslam.cli.console import JsonOption, QuietOption, announce, print_json, progress, say
from segslam.cli.shared_options import with_options

if TYPE_CHECKING:
    from segslam.bench.experiments.job import Job
    from segslam.bench.experiments.pairs import PairList
    from segslam.bench.experiments.rows import Row
    from segslam.bench.experiments.trials import Trial

app = typer.Typer(
    help="Repeat the experiments of the Segregator paper; every method gets the same scans.", no_args_is_help=True
)

LOST_PERCENT = [10.0, 30.0, 50.0, 70.0, 90.0]


@app.command()
@with_options
def pairs(data: DataArgument, options: Options) -> None:
    """Measure the success rate over lists of pairs.

    Example: segslam bench pairs kitti --sequence 06 --pairs kitti06_3to5.txt --sample 100 --workers 4 --out bench06
    """
    _run_pairs("pairs", data, options)


@app.command()
@with_options
def timing(data: DataArgument, options: Options) -> None:
    """Measure the time of each stage, the errors and the graph size, all lists together (paper: sequence 06).

    Example: segslam bench timing kitti --sequence 06 --pairs kitti06_3to5.txt --pairs kitti06_8to10.txt --sample 50
    """
    _run_pairs("timing", data, options)


@app.command()
@with_options
def yaw(
    data: DataArgument,
    options: Options,
    step_deg: Annotated[
        float, typer.Option("--step-deg", min=1, max=180, help="Step between two yaw angles (degrees).")
    ] = 15.0,
) -> None:
    """Measure the error against the yaw of the source, over the full circle. Default pair: scans 0 and 10.

    Example: segslam bench yaw kitti --sequence 05 --step-deg 5 --out yaw05
    """
    job = make_job(data, options)
    from segslam.bench.experiments.trials import PAPER_PAIR, turned_trials

    reference = reference_of(job)
    lists = read_lists(options, reference, default=PAPER_PAIR)
    trials = [trial for one in lists for trial in turned_trials(one, reference, step_deg=step_deg)]
    _run("yaw", job, lists, trials, options, by="yaw_deg", step_deg=step_deg)


@app.command()
@with_options
def deterioration(
    data: DataArgument,
    options: Options,
    lost_percent: Annotated[
        list[float], typer.Option("--lost", min=0, max=100, help="Percentage of labels to remove; may be repeated.")
    ] = LOST_PERCENT,
    clouds: Annotated[
        Literal["one", "both"], typer.Option(help="Remove labels from the source only, or from both scans.")
    ] = "both",
    draws: Annotated[int, typer.Option("--draws", min=1, help="Number of random draws at each percentage.")] = 10,
) -> None:
    """Measure the success while labels are removed at random. Default pair: scans 0 and 10.

    Example: segslam bench deterioration kitti --sequence 05 --labels predictions --clouds one --out lost05
    """
    job = make_job(data, options)
    from segslam.bench.experiments.trials import PAPER_PAIR, unlabelled_trials

    reference = reference_of(job)
    lists = read_lists(options, reference, default=PAPER_PAIR)
    reduced = partial(
        unlabelled_trials, lost_percent=lost_percent, num_draws=draws, seed=options.seed, both=clouds == "both"
    )
    trials = [trial for one in lists for trial in reduced(one, reference)]
    _run("deterioration", job, lists, trials, options, by="lost_percent", clouds=clouds, draws=draws)


@app.command()
def places(
    file: Annotated[
        Path, typer.Argument(help="Places: a .npz with `columns` (n, size, size) uint8 and `poses` (n, 3, 4).")
    ],
    database: Annotated[str, typer.Option("--database", help="Rows of the database: A:B, B excluded.")],
    queries: Annotated[str, typer.Option("--queries", help="Rows of the queries: C:D.")],
    turned: Annotated[bool, typer.Option("--turned", help="Rotate each query by a random yaw.")] = False,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Random seed of --turned.")] = 0,
    json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Measure how often a place is recognised, without labels. A hit is within 5 m; queries without one are omitted.

    Example: segslam bench places kitti_00.npz --database 0:3000 --queries 3200:
    """
    from segslam.bench.experiments.places import PlacesBench, parse_range, read_places

    announce(f"bench places: reading {file}", quiet=quiet)
    seen = read_places(file)
    bench = PlacesBench(
        seen,
        parse_range(database, "--database", len(seen)),
        parse_range(queries, "--queries", len(seen)),
        turned_seed=seed if turned else None,
    )
    for _ in progress(bench.run(), total=bench.num_steps, title="bench places", quiet=quiet):
        pass
    figures = bench.figures()
    if json:
        print_json(figures)
        return
    say(
        f"{figures['num_queries']} queries of {figures['num_places']} places: recall@1 {figures['recall_at_1']:.3f}, "
        f"recall@20 {figures['recall_at_20']:.3f}; {figures['query_ms']:.1f} ms per query, "
        f"{figures['index_bytes']} bytes per place",
        quiet=quiet,
    )


def _run_pairs(experiment: str, data: Path, options: Options) -> None:
    # as in `yaw`, what loads scipy is imported after the first message, which is that of make_job
    job = make_job(data, options)
    from segslam.bench.experiments.trials import pair_trials

    reference = reference_of(job)
    lists = read_lists(options, reference)
    trials = [trial for one in lists for trial in pair_trials(one, reference)]
    _run(experiment, job, lists, trials, options, by="list")


def _run(
    experiment: str,
    job: "Job",
    lists: list["PairList"],
    trials: list["Trial"],
    options: Options,
    *,
    by: str,
    **settings: Any,
) -> None:
    """Register the pairs, print the results, and write the report if a folder is given."""
    from segslam.bench.experiments.paper import with_paper_values
    from segslam.bench.experiments.provenance import account
    from segslam.bench.experiments.report_tables import overall, plain
    from segslam.bench.experiments.summary import results

    rows = run_trials(job, trials, options)
    found = with_paper_values(results(rows, by=by), experiment=experiment, sequence=options.sequence, lists=lists)
    if options.out is not None:
        workers = "of a Dask cluster" if options.scheduler else options.workers
        asked = {"sample": options.sample, "seed": options.seed, "workers": workers, **settings}
        report = account(experiment, job, lists, found, options=asked)
        _write_report(options.out, report, _pictures(job, trials, rows, options.draw), quiet=options.quiet)
    if options.json:
        print_json(found)
    else:
        say(plain(overall(found)), quiet=options.quiet)


def _write_report(out: Path, report: dict[str, Any], pictures: dict[str, bytes], *, quiet: bool) -> None:
    """Write the report, and the pictures as separate files."""
    from segslam.bench.experiments.report import write_bench_report
    from segslam.core.whole_files import write_whole

    write_bench_report(out, report, pictures=pictures)
    for number, png in enumerate(pictures.values()):
        write_whole(out / f"failure_{number:02d}.png", png)
    say(f"{out / 'report.html'}, report.md, report.json, details.csv", quiet=quiet)


def _pictures(job: "Job", trials: list["Trial"], rows: list["Row"], count: int) -> dict[str, bytes]:
    """Pictures of the worst failures, by caption."""
    from segslam.bench.experiments.job import BAD_SCAN, points_of
    from segslam.bench.experiments.summary import worst_failures
    from segslam.output.report.pairs import draw_pair

    trial_of = {trial.key: trial for trial in trials}
    pictures = {}
    for row in worst_failures([row for row in rows if row.reason != BAD_SCAN], count):
        trial = trial_of[row.key[:3]]
        outcome = f"error {row.error_m:.1f} m {row.error_deg:.1f} deg" if row.accepted else row.reason.replace("_", " ")
        caption = f"{row.method}, {row.pairs}: {row.source} to {row.target}{_changes(row)}, {outcome}"
        poses = {"truth": trial.T_target_source} | ({} if row.estimate is None else {"estimate": row.estimate})
        source, target = points_of(job.source, trial.source), points_of(job.source, trial.target)
        pictures[caption] = draw_pair(source, target, poses=poses, title=caption)
    return pictures


def _changes(row: "Row") -> str:
    """Text with the changes made to the scans."""
    turned = f", rotated by {row.source_yaw_deg:g} deg" if row.source_yaw_deg else ""
    return turned + (f", {100 * row.source_lost:g} % of labels lost" if row.source_lost else "")
