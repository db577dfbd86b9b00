"""`segslam optimize`."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from segslam.cli.console import JsonOption, QuietOption, print_json, say
from segslam.errors import SegslamError


def optimize(
    graph: Annotated[Path, typer.Argument(help="A g2o file with VERTEX_SE3:QUAT and EDGE_SE3:QUAT lines.")],
    out: Annotated[Path, typer.Option(help="The g2o file to write: the same edges, the vertices at the optimum.")],
    robust: Annotated[
        Literal["none", "huber", "cauchy", "geman-mcclure", "gnc"],
        typer.Option(help="Least squares, a robust kernel, or graduated non-convexity for edges between distant ids."),
    ] = "none",
    json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Optimise a pose graph. Errors are GTSAM's, half the chi-square.

    Example: segslam optimize parking-garage.g2o --out optimum.g2o --robust gnc
    """
    if not out.parent.is_dir():
        raise SegslamError(f"--out {out}: there is no folder {out.parent}; make it first")
    from segslam.pose_graph import optimize_graph, read_g2o, write_g2o

    result = optimize_graph(read_g2o(graph), robust=robust)
    write_g2o(out, result.graph)
    if json:
        print_json(
            {
                "initial_error": result.initial_error,
                "final_error": result.final_error,
                "iterations": result.iterations,
                "seconds": result.seconds,
                "num_outliers": result.num_outliers,
            }
        )
    else:
        say(
            f"error {result.initial_error:.6g} -> {result.final_error:.6g} in {result.iterations} iterations, "
            f"{result.seconds:.3f} s; {result.num_outliers} outliers; written to {out}",
            quiet=quiet,
        )
