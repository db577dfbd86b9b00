"""The HTML page: headline figures, plots and tables in one file."""

import base64
from collections import Counter
from collections.abc import Iterable, Mapping
from html import escape
from typing import Any

from segslam.core.config import Config, changed_settings
from segslam.core.types import Rejected
from segslam.output.finished import COMPARED, FIGURES, FinishedRun, plain_name
from segslam.output.words import REASONS, WORDS
from segslam.slam.adjustment.vertical_angle import vertical_angle_advice

FILES = {
    "map.png": "the map in top view",
    "map.ply": "the map as a point cloud",
    "before_after.png": "the map by odometry beside the corrected map",
    "poses_tum.txt": "pose of every scan, TUM format, LiDAR frame",
    "poses_kitti.txt": "pose of every scan, KITTI format",
    "odometry_tum.txt": "the same before loop closing, TUM format",
    "odometry_kitti.txt": "the same before loop closing, KITTI format",
    "kiss_icp_tum.txt": "the same by KISS-ICP alone, TUM format",
    "kiss_icp_kitti.txt": "the same by KISS-ICP alone, KITTI format",
    "georeference.json": "place of the map on the globe",
    "gnss.csv": "position fixes: kept, or why not",
    "poses_geodetic.csv": "latitude, longitude, height and heading of every scan",
    "poses_enu_tum.txt": "pose of every scan, east, north and up, TUM format",
    "loops.csv": 'all loop candidates and their outcomes (<a href="#words">words</a>)',
    "graph.g2o": "the pose graph",
    "adjusted.g2o": "all edges of the last estimate, as <code>segslam georeference</code> reads them",
    "metrics.json": "the figures of this page",
    "config.yaml": "the settings",
    "log.mcap": "complete log, for Foxglove and segslam replay",
}
CONDITIONS = {
    "started": "started (UTC)",
    "command": "command",
    "segslam": "segslam",
    "processor": "processor",
    "platform": "system",
    "python": "Python",
}
"""Key in the log -> text on the page."""
STYLE = """
:root { color-scheme: light; --line: #d8dee4; --soft: #57606a; }
body { margin: 0 auto; max-width: 76rem; padding: 1rem; font: 16px/1.45 system-ui, sans-serif; color: #1f2328; }
h1 { font-size: 1.5rem; margin: 0 0 .2rem; } h2 { font-size: 1.1rem; margin: 0 0 .4rem; }
.soft { color: var(--soft); } .plots { columns: 2 30rem; column-gap: 1rem; margin-bottom: 1rem; }
.tiles { display: grid; gap: 1rem; margin: 1rem 0; grid-template-columns: repeat(auto-fit, minmax(9rem, 1fr)); }
section { margin-bottom: 1rem; break-inside: avoid; min-width: 0; overflow-x: auto; }
.tiles div, section { border: 1px solid var(--line); border-radius: .5rem; padding: .7rem .9rem; background: #fff; }
.tiles b { display: block; font-size: 1.4rem; } img { width: 100%; height: auto; display: block; }
table { border-collapse: collapse; width: 100%; font-size: .92rem; }
td, th { text-align: left; padding: .2rem .6rem .2rem 0; border-bottom: 1px solid var(--line); vertical-align: top; }
#pair { display: flex; flex-wrap: wrap; gap: 1rem; } #pair h3 { flex-basis: 100%; margin: .5rem 0 0; font-size: 1rem; }
#pair h4 { margin: 0; text-align: center; }
.panel { flex: 1 1 18rem; min-width: 0; } figure { margin: 0; min-width: 0; overflow-x: auto; }
.gallery { display: grid; gap: 1rem;
  grid-template-columns: repeat(auto-fit, minmax(min(34rem, 100%), 1fr)); } p { margin: .2rem 0 .6rem; }
td.number, th + th { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap; }
th + th { white-space: normal; width: 5.5rem; }
tr.changed td { font-weight: 600; background: #fff8e1; } code { font-size: .9em; overflow-wrap: break-word; }
details { margin: .3rem 0; } summary { cursor: pointer; } details td:first-child { white-space: nowrap; }
@media (max-width: 40rem) { body, section { padding: .5rem; } td code { display: block; }
  th + th { width: 1px; } img[src*="image/png"] { width: 44rem; } }
@media print { body { max-width: none; padding: 0; font-size: 11px; } .plots { columns: 2 7cm; }
  .tiles div, tr, img { break-inside: avoid; } h2, summary { break-after: avoid; }
  section:has(details) { break-inside: auto; }
  details::details-content { content-visibility: visible; height: auto; } }
"""


def page(run: FinishedRun, plots: Mapping[str, str], *, top: str, gallery: str, about: Mapping[str, str]) -> str:
    """The page; `plots`: caption -> SVG, between the HTML `top` and `gallery`; `about`: metadata of its log."""
    name = run.folder.resolve().name
    num_scans = run.metrics.get("num_scans", len(run.result.trajectory))
    title = f"{run.dataset or name}: {num_scans} scan{'s' * (num_scans != 1)}"
    sections = [picture_section(caption, svg) for caption, svg in plots.items()]
    sections += [section("Figures", _figures(run.metrics)), section("Loop candidates", _outcomes(run))]
    sections += [section("Files", _files(run)), section("Conditions", _conditions(run, about))]
    if advice := vertical_angle_advice(run.metrics, run.config.sensor):
        top = f"<p>{escape(advice)}</p>{top}"
    return document(
        title,
        f'<div class="soft">segslam run <code>{escape(name)}</code></div>\n'
        f'<div class="tiles">{_tiles(run.metrics)}</div>\n{top}<div class="plots">{"".join(sections)}</div>\n'
        f"{gallery}{section('Settings', settings_tables(run.config))}",
    )


def loops_section(loops: Mapping[str, bytes]) -> str:
    """PNGs of pairs of scans, by caption; empty without any."""
    if not loops:
        return ""
    shown = "".join(f"<figure>{_picture(caption, png)}</figure>" for caption, png in loops.items())
    note = "Target in grey, source in orange, top view without ground. Left: initial guess of the loop."
    return section("Loops: best accepted, and nearest missed", f'<p>{note}</p><div class="gallery">{shown}</div>')


def _files(run: FinishedRun) -> str:
    """Links to the existing files beside the page."""
    there = {name: text for name, text in FILES.items() if (run.folder / name).is_file()}
    return table((f'<a href="{name}">{name}</a>', text) for name, text in there.items())


def _conditions(run: FinishedRun, about: Mapping[str, str]) -> str:
    facts = {name: about[key] for key, name in CONDITIONS.items() if key in about}
    facts["settings other than the defaults"] = settings_not_default(run.config) or "none"
    return table((escape(name), escape(value)) for name, value in facts.items())


def settings_not_default(config: Config) -> str:
    """The settings that differ from the defaults, in the format of `--set`."""
    return ", ".join(f"{key}={value}" for key, _, value in changed_settings(Config(), config))


def document(title: str, body: str) -> str:
    """A whole HTML file in the style of all reports."""
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}</title><style>{STYLE}</style></head>\n<body><h1>{escape(title)}</h1>"
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
    known = [(key, unit, text) for key, unit, text in tiles if key in metrics]
    return "".join(f"<div><b>{number(metrics[key])}{unit}</b>{text}</div>" for key, unit, text in known)


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
    meanings = {reason.value: f'<div class="soft">{meaning}</div>' for reason, meaning in REASONS.items()}
    rows = ((f"{name.replace('_', ' ')}{meanings.get(name, '')}", count) for name, count in names.most_common())
    return table(rows, head=("", "attempts")) + words


def settings_tables(config: Config) -> str:
    """All settings by section. Changed settings are marked; their sections come first and are open."""
    default = Config()
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
