"""Tables of a benchmark for Markdown, HTML and the terminal: a caption, column titles and rows of text."""

from collections.abc import Callable, Iterable
from html import escape
from typing import Any, NamedTuple

from segslam.bench.experiments.paper import TIMING_KEYS
from segslam.bench.experiments.rows import STAGES
from segslam.output.report.page import number

FIGURES = {
    "num_pairs": "pairs",
    "success_percent": "success %",
    "translation_m": "error m",
    "rotation_deg": "error deg",
    "num_false_accepted": "wrong",
    "num_rejected": "rejected",
    "median_ms": "median ms",
    "p95_ms": "p95 ms",
    "median_cpu_ms": "CPU ms",
    "mean_edges": "edges (AIC)",
    "p95_mb": "p95 MB",
}
TITLES = {"list": "list", "yaw_deg": "yaw (deg)", "lost_percent": "labels lost (%)"}


class Table(NamedTuple):
    """A caption, column titles and rows of text."""

    caption: str
    head: tuple[str, ...]
    rows: list[tuple[str, ...]]


def tables(report: dict[str, Any]) -> list[Table]:
    """All tables of a report, the most important first."""
    results = report["results"]
    by = varied(results)
    if by == "list":
        made = [_success(results)]
    else:
        caption = f"Success (%) by {TITLES[by]}"
        made = [_table_by(results, by, caption, lambda one: f"{one['success_percent']:.1f}")]
    if by == "lost_percent":
        caption = f"Mean error of successes (m / deg; paper's in brackets) by {TITLES[by]}"
        made.append(_table_by(results, by, caption, _error_pair))
    made.append(overall(results))
    if any("paper" in own for own in results.values()):
        made.append(_paper_comparison(results))
    stages = {method: own["stage_ms"] for method, own in results.items()}
    return [*made, _figures_table("Median time of each stage, ms", STAGES, stages)]


def varied(results: dict[str, Any]) -> str:
    """The quantity that the experiment varied."""
    first = next(iter(results.values()))["by"][0]
    return next(key for key in TITLES if key in first)


def markdown(table: Table) -> str:
    """The table as Markdown, with the caption in bold above it."""
    lines = [table.head, tuple("---" for _ in table.head), *table.rows]
    return f"**{table.caption}**\n\n" + "\n".join(f"| {' | '.join(cells)} |" for cells in lines) + "\n"


def html(table: Table) -> str:
    """The table as HTML, without the caption."""
    rows = "".join(_html_row("td", row) for row in table.rows)
    return f"<table>{_html_row('th', table.head)}{rows}</table>"


def text(value: float | None) -> str:
    """A number as text; a dash for None."""
    return "-" if value is None else number(value)


def _success(results: dict[str, Any]) -> Table:
    """Success rate of each method by list, with the paper's value and the difference if known."""
    lists = [one["list"] for one in next(iter(results.values()))["by"]]
    rows = [(method, *(_compared(one) for one in own["by"])) for method, own in results.items()]
    compared = any("paper" in one for own in results.values() for one in own["by"])
    return Table("Success by list, %" + (" (paper, difference)" if compared else ""), ("method", *lists), rows)


def _compared(one: dict[str, Any]) -> str:
    measured = f"{one['success_percent']:.1f}"
    if "paper" not in one:
        return measured
    theirs = one["paper"]["success_percent"]
    return f"{measured} ({theirs:g}, {one['success_percent'] - theirs:+.1f})"


def _table_by(results: dict[str, Any], by: str, caption: str, cell: Callable[[dict[str, Any]], str]) -> Table:
    """A row for each value of the varied quantity, a column for each method."""
    values = [one[by] for one in next(iter(results.values()))["by"]]
    rows = [(f"{value:g}", *(cell(own["by"][place]) for own in results.values())) for place, value in enumerate(values)]
    return Table(caption, (TITLES[by], *results), rows)


def _error_pair(one: dict[str, Any]) -> str:
    def both(values: dict[str, Any]) -> str:
        return f"{text(values['translation_m'])} / {text(values['rotation_deg'])}"

    return both(one) + (f" ({both(one['paper'])})" if "paper" in one else "")


def overall(results: dict[str, Any]) -> Table:
    """The figures of each method over all pairs."""
    return _figures_table("All pairs", FIGURES, results)


def _figures_table(caption: str, titles: dict[str, str], results: dict[str, Any]) -> Table:
    rows = [
        (method, *(f"{own[key]:.1f}" if key == "success_percent" else text(own[key]) for key in titles))
        for method, own in results.items()
    ]
    return Table(caption, ("method", *titles.values()), rows)


def _paper_comparison(results: dict[str, Any]) -> Table:
    rows: list[tuple[str, ...]] = []
    for method, own in results.items():
        for key in TIMING_KEYS:
            if key in own.get("paper", {}) and own[key] is not None:
                theirs = own["paper"][key]
                title = FIGURES.get(key, "mean ms")
                rows.append((f"{method}, {title}", text(own[key]), f"{theirs:g}", f"{own[key] - theirs:+.2f}"))
    return Table("Comparison with the paper's timing table", ("", "measured", "paper", "difference"), rows)


def _html_row(tag: str, cells: Iterable[str]) -> str:
    kinds = ["", *[' class="number"'] * (len(tuple(cells)) - 1)]
    return "<tr>" + "".join(f"<{tag}{k}>{escape(cell)}</{tag}>" for k, cell in zip(kinds, cells, strict=True)) + "</tr>"
