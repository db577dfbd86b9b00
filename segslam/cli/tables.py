"""Tables of figures, a row a run or drive: on the terminal, as CSV and as LaTeX."""

import csv
import io
import shutil
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from segslam.core.whole_files import write_whole
from segslam.output.words import COLUMNS

Rows = Mapping[str, Mapping[str, Any]]
"""Name -> figures."""


def with_meanings(columns: Sequence[Mapping[str, Any]], meanings: Mapping[str, str], *, width: int = 10) -> str:
    """A line for each figure of any column: whole numbers in full, others with four digits, `-` for missing ones.

    The meaning beside them is wrapped to the width of the terminal.
    """
    lines = []
    for key, meaning in meanings.items():
        values = [column.get(key) for column in columns]
        if any(value is not None for value in values):
            shown = ("-" if one is None else str(one) if isinstance(one, int) else f"{one:.4g}" for one in values)
            cells = "".join(f"{cell:>{width}}" for cell in shown) + "  "
            fits = max(shutil.get_terminal_size().columns, len(cells) + 16)  # on a narrow terminal, too
            lines.append(textwrap.fill(meaning, fits, initial_indent=cells, subsequent_indent=" " * len(cells)))
    return "\n".join(lines)


@dataclass(frozen=True)
class TableFiles:
    """Options of commands with a table."""

    csv: Annotated[Path | None, "Write the table to this file, a row for each."] = None
    latex: Annotated[Path | None, "Write the table to this file as a LaTeX tabular, a row for each."] = None

    def write(self, rows: Rows) -> None:
        """Write the files that are given: CSV has all numbers in full, LaTeX the columns for people."""
        for file, text_of in ((self.csv, as_csv), (self.latex, as_latex)):
            if file is not None:
                write_whole(file, text_of(rows))


def as_csv(rows: Rows) -> str:
    """A line of column names (`name`, then keys as in metrics.json), then a line for each row; unknown ones empty."""
    keys = list(dict.fromkeys(key for row in rows.values() for key, value in row.items() if _is_number(value)))
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(["name", *keys])
    writer.writerows([name, *(row.get(key, "") for key in keys)] for name, row in rows.items())
    return stream.getvalue()


def as_latex(rows: Rows) -> str:
    """A tabular with the columns of `words.COLUMNS`, of package booktabs."""
    columns = _columns(rows)
    head = " & ".join(["", *(_escaped(COLUMNS[key]) for key in columns)])
    lines = [" & ".join([_escaped(name), *(_cell(row.get(key)) for key in columns)]) for name, row in rows.items()]
    body = " \\\\\n".join(lines)
    begin = f"\\begin{{tabular}}{{l{'r' * len(columns)}}}"
    parts = [begin, "\\toprule", f"{head} \\\\", "\\midrule", f"{body} \\\\", "\\bottomrule", "\\end{tabular}"]
    return "\n".join([*parts, ""])


def as_text(rows: Rows) -> str:
    """The columns of `words.COLUMNS`."""
    columns = _columns(rows)
    lines = [[name, *(_cell(row.get(key)) for key in columns)] for name, row in rows.items()]
    return aligned([["", *(COLUMNS[key] for key in columns)], *lines])


def aligned(lines: Sequence[Sequence[str]]) -> str:
    """Lines of cells, the first of each at the left; the columns that do not fit the terminal follow below."""
    within = shutil.get_terminal_size().columns
    first, *columns = zip(*lines, strict=True)
    names = [f"{name:<{max(map(len, first))}}" for name in first]
    parts = [names]
    for cells in columns:
        width = max(7, *map(len, cells))
        if parts[-1] is not names and len(parts[-1][0]) + 2 + width > within:
            parts.append(names)
        parts[-1] = [f"{line}  {cell:>{width}}" for line, cell in zip(parts[-1], cells, strict=True)]
    return "\n\n".join("\n".join(lines) for lines in parts)


def _columns(rows: Rows) -> list[str]:
    return [key for key in COLUMNS if any(_is_number(row.get(key)) for row in rows.values())]


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _cell(value: Any) -> str:
    return "-" if not _is_number(value) else f"{value}" if isinstance(value, int) else f"{value:.3f}"


def _escaped(text: str) -> str:
    return "".join(f"\\{letter}" if letter in "&%$#_{}" else letter for letter in text)
