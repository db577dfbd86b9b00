"""`segslam optimize`."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from segslam.cli.checks import check_free
from segslam.cli.console import Terminal
from segslam.cli.options import OverwriteOption
from segslam.core.errors import SegslamError, counted
from segslam.core.whole_files import whole_file

if TYPE_CHECKING:
    from segslam.graph.batch import Optimized


def optimize(
    graph: Annotated[Path, "g2o file with VERTEX_SE3:QUAT and EDGE_SE3:QUAT lines."],
    *,
    out: Annotated[Path, "g2o file to write: the same edges, with the optimised vertices."],
    robust: Annotated[
        Literal["none", "huber", "cauchy", "geman-mcclure", "gnc", "consistent"],
        "Treatment of edges between distant ids. consistent: reject outliers, starting from the largest "
        "pairwise-consistent set, as map does; gnc: reject outliers by graduated non-convexity; huber, cauchy, "
        "geman-mcclure: robust kernel; none: keep all (least squares).",
    ] = "consistent",
    overwrite: OverwriteOption = False,
    force: Annotated[bool, typer.Option(hidden=True, help="The same as --overwrite.")] = False,
    terminal: Terminal,
) -> None:
    """Optimise a pose graph. Errors are half the chi-square, as in GTSAM, of the edges that were not rejected.

    A result that may be wrong is reported with the reason.

    Example: segslam optimize parking-garage.g2o --out optimum.g2o
    """
    check_free([out], overwrite=overwrite or force)
    terminal.announce(f"optimize: reading {graph}")
    from segslam.graph.batch import optimize_graph
    from segslam.graph.g2o import read_g2o, write_g2o
    from segslam.graph.levenberg_marquardt import Unsolvable

    try:
        result = optimize_graph(read_g2o(graph), robust=robust)
    except Unsolvable as error:
        raise SegslamError(f"{graph}: {error}") from error
    with whole_file(out) as part:
        write_g2o(part, result.graph)
    names = (
        *("initial_error", "final_error", "iterations", "seconds", "num_outliers", "robust", "robust_cost", "outliers"),
        *("chi2_per_dof", "converged", "doubts"),
    )
    quantiles = dict(zip(("chi2_median", "chi2_p95", "chi2_max"), result.chi2_quantiles, strict=True))
    figures = {name: getattr(result, name) for name in names} | quantiles
    doubts = (f"the result may be wrong: {doubt}" for doubt in result.doubts)
    terminal.answer(figures, "\n".join([*_lines(result, out), *doubts]))


def _lines(result: "Optimized", out: Path) -> Iterator[str]:
    yield (
        f"error {result.initial_error:.6g} -> {result.final_error:.6g} (half the chi-square of the inlier edges), "
        f"{counted(result.iterations, 'iteration')}, {result.seconds:.3f} s; "
        f"{counted(result.num_outliers, 'outlier')}; written to {out}"
    )
    if result.robust_cost is not None:
        yield f"cost under the kernel {result.robust}: {result.robust_cost:.6g}"
    median, p95, most = result.chi2_quantiles
    per_dof = "not redundant" if result.chi2_per_dof is None else f"{result.chi2_per_dof:.3g} per degree of freedom"
    yield f"chi-square of the inlier edges: {per_dof}; median {median:.3g}, 95 % {p95:.3g}, maximum {most:.3g}"
