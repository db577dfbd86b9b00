"""`segslam bench`: the paper's experiments, each method on the same scans."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from segslam.cli.console import (
    ConfigOption,
    DatasetOption,
    EncodingOption,
    JsonOption,
    LabelsOption,
    QuietOption,
    SequenceOption,
    SetOption,
    print_json,
    progress,
    say,
)
from segslam.experiments.settings import METHOD_NAMES

if TYPE_CHECKING:
    from segslam.experiments.job import Job
    from segslam.experiments.pairs import PairList
    from segslam.experiments.rows import Row
    from segslam.experiments.trials import Trial

app = typer.Typer(help="The paper's experiments, each method on the same scans.", no_args_is_help=True)

DataArgument = Annotated[Path, typer.Argument(help="KITTI's folder, of real or simulated scans.")]
MethodOption = Annotated[
    list[str] | None,
    typer.Option("--method", help=f"May be repeated; all that are installed unless given: {', '.join(METHOD_NAMES)}."),
]
PairsOption = Annotated[
    list[Path] | None,
    typer.Option("--pairs", help="List of pairs, `source target` a line, or JSON with true poses; may be repeated."),
]
SampleOption = Annotated[int | None, typer.Option("--sample", min=1, help="Draw so many pairs of each list.")]
SeedOption = Annotated[int, typer.Option("--seed", min=0, help="Of what is drawn.")]
WorkersOption = Annotated[int, typer.Option("--workers", min=1, help="Processes on this machine (extra `cluster`).")]
SchedulerOption = Annotated[
    str | None, typer.Option("--scheduler", help="Address of a Dask cluster that sees DATA (extra `cluster`).")
]
OutOption = Annotated[
    Path | None, typer.Option("--out", help="Folder for report and rows; the same command goes on where it stopped.")
]
DetailsOption = Annotated[Path | None, typer.Option("--details", help="Write a CSV file with a row a registration.")]


@app.command()
def pairs(
    data: DataArgument,
    pairs: PairsOption = None,
    min_m: Annotated[float | None, typer.Option(min=0, help="Cut a list from true poses: least distance.")] = None,
    max_m: Annotated[float | None, typer.Option(min=0, help="And greatest.")] = None,
    min_gap: Annotated[int, typer.Option(min=1, help="And scans between the two at least.")] = 50,
    sample: SampleOption = None,
    seed: SeedOption = 0,
    sequence: SequenceOption = "00",
    method: MethodOption = None,
    dataset: DatasetOption = None,
    labels: LabelsOption = "auto",
    encoding: EncodingOption = None,
    config: ConfigOption = None,
    settings: SetOption = None,
    workers: WorkersOption = 1,
    scheduler: SchedulerOption = None,
    out: OutOption = None,
    details: DetailsOption = None,
    json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Success rates over lists of pairs.

    Example: segslam bench pairs kitti --sequence 06 --pairs kitti06_3to5.txt --sample 100 --workers 4 --out bench06
    """
    from segslam.experiments.benchmark import Pool
    from segslam.experiments.pairs import pair_trials
    from segslam.experiments.summary import by_method, figures

    job = make_job(data, sequence, dataset, labels, encoding, method, config, settings, quiet=quiet)
    opened = job.source.open()
    lists = read_lists(pairs, min_m, max_m, min_gap, opened.reference, sample=sample, seed=seed)
    trials = [trial for one in lists for trial in pair_trials(one, opened.reference)]
    rows = run_trials(job, trials, Pool(workers, scheduler), out, details, quiet=quiet)
    results = {name: figures(own) for name, own in by_method(rows).items()}
    if json:
        print_json(results)
    else:
        say(table(results), quiet=quiet)


def make_job(
    data: Path,
    sequence: str,
    dataset: str | None,
    labels: str,
    encoding: Any,
    methods: list[str] | None,
    config: Path | None,
    settings: list[str] | None,
    *,
    quiet: bool,
) -> "Job":
    """What the options ask for. Methods that are not named and not installed are left out, with a line each."""
    one_thread_each()
    from segslam.config import load_config
    from segslam.experiments.job import DataSource, Job
    from segslam.experiments.methods import find_method
    from segslam.types import SegslamError

    chosen = []
    for name in dict.fromkeys(methods or METHOD_NAMES):
        try:
            find_method(name)
        except SegslamError as error:
            if methods:
                raise
            say(f"left out: {error}", quiet=quiet)
        else:
            chosen.append(name)
    source = DataSource(data.expanduser().absolute(), sequence, dataset, labels, encoding)
    return Job(source, tuple(chosen), load_config(config, settings or ()))


def read_lists(
    files: list[Path] | None,
    min_m: float | None,
    max_m: float | None,
    min_gap: int,
    reference: Any,
    *,
    sample: int | None,
    seed: int,
) -> list["PairList"]:
    """The lists of files, or the one that the distances cut."""
    from segslam.experiments.pairs import cut_pairs, read_pairs, sample_pairs
    from segslam.types import SegslamError

    if bool(files) == (min_m is not None or max_m is not None):
        raise SegslamError("give lists by --pairs FILE, or cut one by --min-m and --max-m")
    if files:
        lists = [read_pairs(file) for file in files]
    else:
        if min_m is None or max_m is None or not min_m < max_m:
            raise SegslamError(f"--min-m {min_m} --max-m {max_m}: give both, the lesser first")
        if reference is None:
            raise SegslamError("--min-m: the data set has no true poses to cut a list from; give --pairs FILE")
        name = f"cut_{min_m:g}to{max_m:g}"
        lists = [cut_pairs(reference, name=name, min_m=min_m, max_m=max_m, min_gap=min_gap)]
        if not len(lists[0].pairs):
            raise SegslamError(f"--min-m {min_m} --max-m {max_m} --min-gap {min_gap}: there is no such pair of scans")
    return lists if sample is None else [sample_pairs(one, num_pairs=sample, seed=seed) for one in lists]


def run_trials(
    job: "Job", trials: list["Trial"], pool: Any, out: Path | None, details: Path | None, *, quiet: bool
) -> list["Row"]:
    """All rows in the order of the trials. Stopped by Ctrl-C, those that are done are kept in `out`."""
    from segslam.experiments.benchmark import in_order, run
    from segslam.experiments.rows import row_writer

    rows: list[Row] = []
    try:
        for some in progress(run(job, trials, pool=pool, folder=out), total=len(trials), title="bench", quiet=quiet):
            rows += some
    except KeyboardInterrupt:
        kept = f"; the same command goes on from {out}" if out else ""
        say(f"stopped after {len(rows)} registrations{kept}", quiet=quiet)
        raise typer.Exit(130) from None
    rows = in_order(rows, job, trials)
    if details is not None:
        with row_writer(details, rows):
            pass
    return rows


def one_thread_each() -> None:
    """Keep Open3D and others from taking all cores, before they are loaded: methods are timed on one core each."""
    import os

    for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
        os.environ.setdefault(variable, "1")


def table(results: dict[str, dict[str, Any]]) -> str:
    """Figures by method, for a person."""
    columns = {
        "success_percent": "success %",
        "translation_m": "m",
        "rotation_deg": "deg",
        "num_false_accepted": "wrong",
        "num_rejected": "rejected",
        "median_ms": "median ms",
        "p95_ms": "p95 ms",
        "median_cpu_ms": "CPU ms",
        "mean_edges": "edges",
        "peak_mb": "MB",
    }
    lines = [f"{'':16}" + "".join(f"{title:>11}" for title in columns.values())]
    for name, own in results.items():
        lines.append(f"{name:16}" + "".join(f"{number(own[key]):>11}" for key in columns))
    return "\n".join(lines)


def number(value: float | None) -> str:
    """Some three digits; a dash for what is not known."""
    if value is None:
        return "-"
    if isinstance(value, int):
        return str(value)
    return f"{value:.3f}" if abs(value) < 1 else f"{value:.2f}" if abs(value) < 10 else f"{value:.1f}"
