"""The report: one file, whole, readable by a browser, saying what the run's files say."""

import base64
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from xml.etree import ElementTree

import pytest
from finished_run import make_run
from matplotlib.image import imread

from segslam import cli
from segslam.config import Config, load_config
from segslam.report import draw_picture, write_report
from segslam.report.figures import draw_loops
from segslam.report.page import page
from segslam.results import FIGURES, read_run
from segslam.run_files import write_metrics
from segslam.runs import accuracy
from segslam.types import SegslamError

VOID = {"meta", "img"}


class _Tags(HTMLParser):
    """Checks that every tag is closed in its turn, and collects what the page would load."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.loads: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.loads += [value or "" for name, value in attrs if name in ("src", "href")]
        assert tag not in ("script", "link", "iframe")
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def _plots(html: str) -> dict[str, str]:
    """Caption -> the SVG's text."""
    found = re.findall(r'<img alt="([^"]*)" src="data:image/svg\+xml;base64,([^"]*)">', html)
    return {caption: base64.b64decode(data).decode() for caption, data in found}


def _scored_run(folder: Path) -> Path:
    made = make_run(folder)
    run = read_run(made.folder)
    assert run.reference is not None
    write_metrics(made.folder, run.metrics | accuracy(run.result, run.reference))
    return made.folder


def test_a_map_from_above_is_on_the_page(tmp_path: Path) -> None:
    folder = _scored_run(tmp_path / "run")
    assert "Map from above" not in write_report(folder).read_text()
    (folder / "map.png").write_bytes(b"a picture")
    [data] = re.findall(r'alt="Map from above" src="data:image/png;base64,([^"]*)">', write_report(folder).read_text())
    assert base64.b64decode(data) == b"a picture"


def test_page_is_whole_and_loads_nothing(tmp_path: Path) -> None:
    file = write_report(_scored_run(tmp_path / "run"))
    assert file == tmp_path / "run" / "report.html"
    html = file.read_text()
    tags = _Tags()
    tags.feed(html)
    assert tags.open == []
    assert len(tags.loads) == 4
    assert all(target.startswith("data:") for target in tags.loads)
    for svg in _plots(html).values():
        ElementTree.fromstring(svg)
        assert not re.search(r'href="(?!#)', svg)


def test_loops_are_counted_by_outcome_and_the_false_one_is_shown(tmp_path: Path) -> None:
    plots = _plots(write_report(_scored_run(tmp_path / "run")).read_text())
    loops = plots["Loops by outcome"]
    for label in ("accepted (3)", "false (1)", "small clique (5)", "low overlap (1)"):
        assert label in loops
    assert "switched off" not in loops  # the graph's doubt about the false one adds nothing


def test_without_truth_nothing_is_compared_with_it(tmp_path: Path) -> None:
    html = write_report(make_run(tmp_path / "run", with_truth=False).folder).read_text()
    plots = _plots(html)
    assert "Error along the drive, after alignment" not in plots
    assert "truth" not in plots["Trajectory from above, and its height"]
    assert "switched off (1)" in plots["Loops by outcome"]
    assert "error after alignment" not in html


def test_every_figure_is_in_the_table_with_its_meaning(tmp_path: Path) -> None:
    folder = _scored_run(tmp_path / "run")
    html = write_report(folder).read_text()
    metrics = read_run(folder).metrics
    for key in metrics:
        if key != "stage_ms" and not key.startswith("odometry_"):
            assert f"<code>{key}</code>" in html
    assert f"{metrics['odometry_ate_m']:.3f}" in html
    assert FIGURES["ate_m"] in html


def test_changed_settings_are_marked_and_shown_open(tmp_path: Path) -> None:
    run = read_run(make_run(tmp_path / "run").folder)
    assert '<tr class="changed">' not in page(run, {})
    changed = page(replace(run, config=load_config(None, ["keyframes.distance_m=1.25"])), {})
    assert re.search(r'<details open><summary>keyframes</summary>.*<tr class="changed"><td><code>distance_m', changed)
    assert changed.count('<tr class="changed">') == 1
    for section in Config.model_fields:
        assert f"<summary>{section}</summary>" in changed


def test_names_are_not_taken_for_markup(tmp_path: Path) -> None:
    run = read_run(make_run(tmp_path / "run").folder)
    assert "<script>" not in page(replace(run, dataset="<script>alert(1)</script>"), {"<script>": "<svg/>"})


def test_same_run_gives_the_same_page(tmp_path: Path) -> None:
    folder = make_run(tmp_path / "run").folder
    assert write_report(folder).read_text() == write_report(folder).read_text()


def test_run_without_loops_is_drawn(tmp_path: Path) -> None:
    run = read_run(make_run(tmp_path / "run").folder)
    bare = replace(run, metrics={}, result=replace(run.result, attempts=()))
    html = page(bare, {"Loops": draw_loops(bare)})
    assert "No place was visited twice" in html
    assert "accepted" not in _plots(html)["Loops"]


def test_picture_is_a_png_beside_the_run(tmp_path: Path) -> None:
    file = draw_picture(make_run(tmp_path / "run").folder)
    assert file == tmp_path / "run" / "picture.png"
    height, width, _ = imread(file).shape
    assert (height, width) == (600, 1280)


def test_folder_that_cannot_be_written_to_is_named(tmp_path: Path) -> None:
    folder = make_run(tmp_path / "run").folder
    (folder / "report.html").mkdir()
    with pytest.raises(SegslamError, match=r"report\.html: cannot be written"):
        write_report(folder)


def test_unfinished_run_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SegslamError, match="did not finish"):
        write_report(make_run(tmp_path / "run", finished=False).folder)


def test_command_writes_the_page_and_says_where(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = make_run(tmp_path / "run").folder
    for arguments, status, said in (
        (["report", str(folder)], 0, f"report in {folder / 'report.html'}\n"),
        (["report", str(tmp_path / "nowhere")], 2, "nowhere: no such folder"),
    ):
        with pytest.raises(SystemExit) as ended:
            cli.main(arguments)
        assert int(ended.value.code or 0) == status
        assert said in capsys.readouterr().err
    assert (folder / "report.html").stat().st_size > 10_000
