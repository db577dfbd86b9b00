"""The HTML page: headline figures, plots and tables in one file."""

import base64
from collections import Counter
from collections.abc import Iterable, Mapping
from html import escape
from importlib import resources
from typing import Any

from segslam.core.config import Config, changed_settings
from segslam.core.errors import counted, noun
from segslam.core.types import Rejected
from segslam.output.finished import COMPARED, FinishedRun, plain_name
from segslam.output.words import CONDITIONS, FIGURES, FILES, REASONS, WORDS
from segslam.scans.presets import defaults_in_effect
from segslam.slam.adjustment.vertical_angle import vertical_angle_advice


def page(run: FinishedRun, plots: Mapping[str, str], *, top: str, gallery: str, about: Mapping[str, str]) -> str:
    """The page; `plots`: caption -> SVG, between the HTML `top` and `gallery`; `about`: metadata of its log."""
    name = run.folder.resolve().name
    num_scans = run.metrics.get("num_scans", len(run.result.trajectory))
    title = f"{run.dataset or name}: {counted(num_scans, 'scan')}"
    sections = [picture_section(caption, svg) for caption, svg in plots.items()]
    sections += [section("Figures", _figures(run.metrics)), section("Loop candidates", _outcomes(run))]
    sections += [section("Files", _files(run)), section("Conditions", _conditions(run, about))]
    if advice := vertical_angle_advice(run.metrics, run.config.sensor):
        top = f"<p>{escape(advice)}</p>{top}"
    return document(
        title,
        f'<div class="soft">segslam run <code>{escape(name)}</code></div>\n'
        f'<div class="tiles">{_tiles(run.metrics)}</div>\n{top}<div class="plots">{"".join(sections)}</div>\n'
        f"{gallery}{section('Settings', settings_tables(run.config, _defaults(run)))}",
    )


def loops_section(loops: Mapping[str, bytes]) -> str:
    """PNGs of pairs of scans, by caption; empty without any."""
    if not loops:
        return ""
    shown = "".join(f"<figure>{_picture(caption, png)}</figure>" for caption, png in loops.items())
    note = "Target in grey, source in orange, top view without ground. Left: initial guess of the loop."
    return section("Loops: best accepted, and nearest missed", f'<p>{note}</p><div class="gallery">{shown}</div>')


def _files(run: FinishedRun) -> str:
    there = {name: text for name, text in FILES.items() if (run.folder / name).is_file()}
    return table((f'<a href="{name}">{name}</a>', text) for name, text in there.items())


def _conditions(run: FinishedRun, about: Mapping[str, str]) -> str:
    facts = {name: about[key] for key, name in CONDITIONS.items() if key in about}
    facts["settings other than the defaults"] = settings_not_default(run.config, _defaults(run)) or "none"
    return table((escape(name), escape(value)) for name, value in facts.items())


def _defaults(run: FinishedRun) -> Config:
    return defaults_in_effect(run.config, run.T_camera_lidar)


def settings_not_default(config: Config, default: Config) -> str:
    """The settings that differ from the defaults, in the format of `--set`."""
    return ", ".join(f"{key}={value}" for key, _, value in changed_settings(default, config))


def document(title: str, body: str) -> str:
    """A whole HTML file in the style of all reports."""
    style = resources.files("segslam.output.report").joinpath("style.css").read_text(encoding="utf-8")
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}</title><style>\n{style}</style></head>\n<body><h1>{escape(title)}</h1>"
        f"{body}</body></html>\n"
    )


def _tiles(metrics: dict[str, Any]) -> str:
    tiles = [
        ("ate_m", " m", "error after alignment"),
        ("odometry_ate_m", " m", "error of the odometry, after repairs"),
        ("kiss_icp_ate_m", " m", "error of KISS-ICP alone"),
        ("length_m", " m", "length of the drive"),
        ("duration_s", " s", "duration of the drive"),
        ("num_loops_accepted", "", "loops accepted"),
        ("num_loops_false", "", "false loops"),
        ("scans_per_second", "", "scans per second"),
        ("peak_rss_mb", " MB", "peak memory"),
    ]
    known = [(metrics[key], unit, text) for key, unit, text in tiles if key in metrics]
    named = [(value, unit, text.replace("loops", noun(value, "loop"))) for value, unit, text in known]
    return "".join(f"<div><b>{number(value)}{unit}</b>{text}</div>" for value, unit, text in named)


def picture_section(caption: str, picture: str | bytes, *, note: str = "") -> str:
    """An SVG or PNG and its caption; between them a note."""
    return section(caption, (f"<p>{note}</p>" if note else "") + _picture(caption, picture))


def _picture(caption: str, picture: str | bytes) -> str:
    kind, content = ("svg+xml", picture.encode()) if isinstance(picture, str) else ("png", picture)
    data = base64.b64encode(content).decode()
    return f'<img alt="{escape(caption)}" src="data:image/{kind};base64,{data}">'


def _figures(metrics: dict[str, Any]) -> str:
    """Figures with a description first, in their order, then the others; each beside those of the odometry."""
    known = [key for key in FIGURES if key in metrics]
    rest = [key for key, value in metrics.items() if key not in FIGURES and isinstance(value, int | float)]
    of_run = [key for key in known + rest if plain_name(key) == key]
    titles = {prefix: title for prefix, title in COMPARED.items() if f"{prefix}ate_m" in metrics}
    rows = [
        (f"{FIGURES.get(key, '')} {_key(key)}", metrics[key], *(metrics.get(prefix + key) for prefix in titles))
        for key in of_run
    ]
    return table(rows, head=("", "run", *titles.values()))


def _key(name: str) -> str:
    """A key as code, which may be broken after underscores and dots."""
    return f"<code>{escape(name).replace('_', '_<wbr>').replace('.', '.<wbr>')}</code>"


def _outcomes(run: FinishedRun) -> str:
    """How often each outcome came, with what the words of `loops.csv` mean."""
    meant = table((word, escape(meaning)) for word, meaning in WORDS.items())
    words = f'<details id="words"><summary>What the words mean</summary>{meant}</details>'
    if not run.result.attempts:
        return f"<p>No pair of keyframes was proposed as a loop.</p>{words}"
    outcomes = (attempt.outcome for attempt in run.result.attempts)
    names = Counter(outcome.reason.value if isinstance(outcome, Rejected) else "accepted" for outcome in outcomes)
    meanings = {reason: f'<div class="soft">{meaning}</div>' for reason, meaning in REASONS.items()}
    rows = ((f"{name.replace('_', ' ')}{meanings.get(name, '')}", count) for name, count in names.most_common())
    return table(rows, head=("", "attempts")) + words


def settings_tables(config: Config, default: Config) -> str:
    """All settings by section. Changed settings are marked; their sections come first and are open."""
    tables = ""
    for name in sorted(Config.model_fields, key=lambda name: getattr(config, name) == getattr(default, name)):
        values, usual = (getattr(one, name).model_dump(mode="json") for one in (config, default))
        rows = ""
        for key, setting in type(getattr(config, name)).model_fields.items():
            kind = ' class="changed"' if values[key] != usual[key] else ""
            cells = _key(key), escape(str(values[key])), escape(" ".join((setting.description or "").split()))
            rows += f"<tr{kind}>" + "".join(f"<td>{cell}</td>" for cell in cells) + "</tr>"
        is_open = " open" if values != usual else ""
        tables += f"<details{is_open}><summary>{name}</summary><table>{rows}</table></details>"
    return tables


def section(title: str, body: str) -> str:
    """A box with a heading; `body` is HTML."""
    return f"<section><h2>{escape(title)}</h2>{body}</section>\n"


def table(rows: Iterable[Iterable[str | float | None]], *, head: Iterable[str] = ()) -> str:
    """Rows of HTML and numbers; unknown numbers are None. Heads of columns with HTML are on the left, as these."""
    cells = [tuple(row) for row in rows]
    titles = ""
    for column, title in enumerate(head):
        has_text = column > 0 and any(isinstance(row[column], str) for row in cells)
        style = ' style="text-align: left; width: auto"' if has_text else ""
        titles += f"<th{style}>{title}</th>"
    lines = "".join(f"<tr>{''.join(map(_cell, row))}</tr>" for row in cells)
    return f"<table>{f'<tr>{titles}</tr>' if titles else ''}{lines}</table>"


def _cell(value: str | float | None) -> str:
    if isinstance(value, str):
        return f"<td>{value}</td>"
    return f'<td class="number">{"" if value is None else number(value)}</td>'


def number(value: float) -> str:
    """At least three significant digits, and at most three decimals."""
    if isinstance(value, int):
        return str(value)
    digits = 3 if abs(value) < 1 else 2 if abs(value) < 10 else 1 if abs(value) < 100 else 0
    return f"{value:.{digits}f}"
