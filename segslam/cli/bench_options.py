"""What all commands of `segslam bench` take, and what they do alike: open, run, report."""

import inspect
import os
from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import wraps
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
    progress,
    say,
)
from segslam.errors import SegslamError
from segslam.experiments.settings import METHOD_NAMES

if TYPE_CHECKING:
    from segslam.experiments.job import Job
    from segslam.experiments.pairs import PairList
    from segslam.experiments.rows import Row
    from segslam.experiments.trials import Trial
    from segslam.types import Trajectory

THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")

DataArgument = Annotated[Path, typer.Argument(help="KITTI's folder, of real or simulated scans.")]


@dataclass(frozen=True)
class Options:
    """The options that every experiment takes."""

    pairs: Annotated[
        list[Path] | None,
        typer.Option("--pairs", help="List of pairs, `source target` a line, or JSON with their poses; repeatable."),
    ] = None
    min_m: Annotated[float | None, typer.Option("--min-m", min=0, help="Cut a list from true poses: from (m)")] = None
    max_m: Annotated[float | None, typer.Option("--max-m", min=0, help="to this distance (m),")] = None
    min_gap: Annotated[int, typer.Option("--min-gap", min=1, help="at least so many scans apart.")] = 50
    sample: Annotated[int | None, typer.Option("--sample", min=1, help="Draw so many pairs of each list.")] = None
    seed: Annotated[int, typer.Option("--seed", min=0, help="Of what is drawn.")] = 0
    sequence: SequenceOption = "00"
    method: Annotated[
        list[str] | None,
        typer.Option("--method", help=f"Repeatable; all unless given: {', '.join(METHOD_NAMES)}."),
    ] = None
    dataset: DatasetOption = None
    labels: LabelsOption = "auto"
    encoding: EncodingOption = None
    config: ConfigOption = None
    settings: SetOption = None
    workers: Annotated[int, typer.Option("--workers", min=1, help="Processes on this machine (extra `cluster`).")] = 1
    scheduler: Annotated[
        str | None, typer.Option("--scheduler", help="Address of a Dask cluster that sees DATA (extra `cluster`).")
    ] = None
    out: Annotated[
        Path | None, typer.Option("--out", help="Folder of report and rows; the same command again goes on there.")
    ] = None
    details: Annotated[Path | None, typer.Option("--details", help="Write a CSV file, a row a registration.")] = None
    draw: Annotated[int, typer.Option("--draw", min=0, help="Draw so many of the worst failures; needs --out.")] = 0
    json: JsonOption = False
    quiet: QuietOption = False


def with_options(command: Callable[..., None]) -> Callable[..., None]:
    """The command, taking the fields of `Options` as options of its own; its parameter `options` gets them all."""
    own = inspect.signature(command, eval_str=True)
    shared = {field.name: (field.type, field.default) for field in fields(Options)}

    @wraps(command)
    def typed(**values: Any) -> None:
        options = Options(**{name: values.pop(name) for name in shared})
        command(**values, options=options)

    parameters = [parameter for name, parameter in own.parameters.items() if name != "options"]
    parameters += [
        inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, annotation=kind, default=default)
        for name, (kind, default) in shared.items()
    ]
    kept = [parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY) for parameter in parameters]
    typed.__signature__ = own.replace(parameters=kept)  # type: ignore[attr-defined]
    typed.__annotations__ = {parameter.name: parameter.annotation for parameter in kept}
    return typed


def make_job(data: Path, options: Options) -> "Job":
    """What the options ask for. Methods that are not named and not installed are left out, with a line each."""
    _one_thread_each()
    from segslam.config import load_config
    from segslam.experiments.job import DataSource, Job
    from segslam.experiments.methods import find_method

    if options.draw and options.out is None:
        raise SegslamError("--draw: the pictures need a folder; give --out DIR")
    chosen = []
    for name in dict.fromkeys(options.method or METHOD_NAMES):
        try:
            find_method(name)
        except SegslamError as error:
            if options.method:
                raise
            say(f"left out: {error}", quiet=options.quiet)
        else:
            chosen.append(name)
    source = DataSource(
        data.expanduser().absolute(), options.sequence, options.dataset, options.labels, options.encoding
    )
    return Job(source, tuple(chosen), load_config(options.config, options.settings or ()))


def reference_of(job: "Job") -> "Trajectory | None":
    """The true poses of the data set."""
    from segslam.experiments.job import open_once

    dataset, _ = open_once(job.source)
    return dataset.reference


def read_lists(
    options: Options, reference: "Trajectory | None", *, default: "PairList | None" = None
) -> list["PairList"]:
    """The lists of files, or the one that the distances cut, or the default; sampled where that is asked for."""
    from segslam.experiments.pairs import cut_pairs, read_pairs, sample_pairs

    cuts = options.min_m is not None or options.max_m is not None
    if options.pairs and cuts:
        raise SegslamError("--pairs, --min-m: give lists by files, or cut one by --min-m and --max-m, not both")
    if options.pairs:
        lists = [read_pairs(file) for file in options.pairs]
    elif cuts:
        lists = [cut_pairs(_posed(reference), **_bounds(options))]
    elif default is not None:
        lists = [default]
    else:
        raise SegslamError("--pairs: give a list of pairs, or cut one from the true poses by --min-m and --max-m")
    if options.sample is None:
        return lists
    return [sample_pairs(one, num_pairs=options.sample, seed=options.seed) for one in lists]


def run_trials(job: "Job", trials: list["Trial"], options: Options) -> list["Row"]:
    """All rows in the order of the trials. Stopped by Ctrl-C, those that are done stay in the folder of `--out`."""
    from segslam.experiments.benchmark import Pool, in_order, run
    from segslam.experiments.rows import write_rows

    rows: list[Row] = []
    pool = Pool(options.workers, options.scheduler)
    work = run(job, trials, pool=pool, folder=options.out)
    try:
        for some in progress(work, total=len(trials), title="bench", quiet=options.quiet):
            rows += some
    except KeyboardInterrupt:
        kept = f"; the same command goes on from {options.out}" if options.out else ""
        say(f"stopped after {len(rows)} registrations{kept}", quiet=options.quiet)
        raise typer.Exit(130) from None
    rows = in_order(rows, job, trials)
    if options.details is not None:
        write_rows(options.details, rows)
    return rows


def _bounds(options: Options) -> dict[str, Any]:
    if options.min_m is None or options.max_m is None or not options.min_m < options.max_m:
        raise SegslamError(f"--min-m {options.min_m} --max-m {options.max_m}: give both, the lesser first")
    name = f"cut_{options.min_m:g}to{options.max_m:g}"
    return {"name": name, "min_m": options.min_m, "max_m": options.max_m, "min_gap": options.min_gap}


def _posed(reference: "Trajectory | None") -> "Trajectory":
    if reference is None:
        raise SegslamError("--min-m: the data has no true poses to cut a list from; give --pairs FILE")
    return reference


def _one_thread_each() -> None:
    """Keep Open3D and others from taking all cores, before they are loaded: methods are timed on one core each."""
    for variable in THREAD_VARIABLES:
        os.environ.setdefault(variable, "1")
