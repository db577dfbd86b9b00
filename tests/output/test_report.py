"""The report: one complete HTML file with the figures of the run's files."""

import base64
import re
import shutil
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from html.parser import HTMLParser
from itertools import cycle, pairwise
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import matplotlib
import numpy as np
import pytest
from helpers.finished_run import make_run
from matplotlib.figure import Figure
from PIL import Image

from segslam import cli
from segslam.core import geometry, processes
from segslam.core.config import Config, load_config
from segslam.core.types import MotionState, RejectReason, SegslamError
from segslam.output.accuracy import accuracy
from segslam.output.finished import FinishedRun, read_run
from segslam.output.folder import ALONE, write_metrics, write_poses
from segslam.output.map.from_above import small_png
from segslam.output.report import figures, loops, write_report
from segslam.output.report.figures import draw_loops, paths_of
from segslam.output.report.loops import choose
from segslam.output.report.page import number, page, settings_not_default
from segslam.output.words import FIGURES, REASONS
from segslam.slam.slam_result import outcome_text

VOID = {"meta", "img", "wbr"}


class _Tags(HTMLParser):
    """Checks that every tag is closed in its turn, and collects what the page would load."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.loads: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.loads += [value or "" for name, value in attrs if name in ("src", "href")]
        assert tag not in ("link", "iframe")
        assert tag != "script" or "src" not in dict(attrs)
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def _plots(html: str) -> dict[str, str]:
    """Caption -> the SVG's text."""
    found = re.findall(r'<img alt="([^"]*)" src="data:image/svg\+xml;base64,([^"]*)">', html)
    return {caption: base64.b64decode(data).decode() for caption, data in found}


@pytest.fixture(scope="module")
def scored(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page of a run with ground truth."""
    made = make_run(tmp_path_factory.mktemp("scored") / "run")
    run = read_run(made.folder)
    assert run.reference is not None
    write_metrics(made.folder, run.metrics | accuracy(run.result, run.reference))
    return write_report(made.folder)


def _page(run: FinishedRun, plots: dict[str, str]) -> str:
    return page(run, plots, top="", gallery="", about={})


@pytest.mark.long
def test_a_map_from_above_is_on_the_page(scored: Path, tmp_path: Path) -> None:
    assert "Map in top view" not in scored.read_text()
    folder = shutil.copytree(scored.parent, tmp_path / "run")
    Image.new("RGB", (300, 200)).save(folder / "map.png")
    html = write_report(folder).read_text()
    [data] = re.findall(r'alt="Map in top view" src="data:image/png;base64,([^"]*)">', html)
    assert base64.b64decode(data) == (folder / "map.png").read_bytes()
    assert html.index("Map by odometry, and corrected") < html.index("Map in top view") < html.index("Trajectory, top")


def test_a_large_map_is_reduced_on_the_page(tmp_path: Path) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (2000, 3000, 3), np.uint8)
    Image.fromarray(noise).save(tmp_path / "map.png")
    (tmp_path / "small.png").write_bytes(small_png(tmp_path / "map.png"))
    with Image.open(tmp_path / "small.png") as small:
        assert small.size == (1500, 1000)


def test_page_is_whole_and_loads_nothing(scored: Path) -> None:
    assert scored.name == "report.html"
    html = scored.read_text()
    tags = _Tags()
    tags.feed(html)
    assert tags.open == []
    links = [target for target in tags.loads if not target.startswith("data:")]
    assert {"poses_tum.txt", "log.mcap"} & set(links) == {"log.mcap"}  # this run has no poses_tum.txt
    assert all((scored.parent / link).is_file() for link in links)
    assert len(tags.loads) - len(links) == 1 + 5 + 2  # the map, the plots, an accepted loop and a missed one
    for svg in _plots(html).values():
        ElementTree.fromstring(svg)
        assert not re.search(r'href="(?!#)', svg)


def test_loops_are_counted_by_outcome_and_the_false_one_is_shown(scored: Path) -> None:
    plots = _plots(scored.read_text())
    loops = plots["Loops by outcome"]
    for label in ("accepted (3)", "false (1)", "small clique (5)", "low overlap (1)"):
        assert label in loops
    assert "rejected by the optimiser" not in loops  # the low weight of the false one adds nothing


def test_all_plots_are_in_the_frame_of_the_run(tmp_path: Path) -> None:
    run = read_run(make_run(tmp_path / "run").folder)
    assert run.reference is not None
    T_other_world = geometry.transform(geometry.yaw(2.0), [300.0, -80.0, 5.0])
    moved = replace(run, reference=replace(run.reference, T_world_lidar=T_other_world @ run.reference.T_world_lidar))
    truth, _, corrected = paths_of(moved)
    np.testing.assert_array_equal(corrected.poses, run.result.trajectory.T_world_lidar)
    np.testing.assert_allclose(truth.poses[:, :3, 3], run.reference.T_world_lidar[:, :3, 3], atol=0.05)


@pytest.mark.long
def test_kiss_icp_alone_is_drawn_and_scored_beside_the_repaired_odometry(tmp_path: Path) -> None:
    made = make_run(tmp_path / "run")
    off = made.result.odometry.T_world_lidar.copy()
    off[60:, 1, 3] += 8.0
    write_poses(made.folder, ALONE, replace(made.result.odometry, T_world_lidar=off), None)
    run = read_run(made.folder)
    assert run.reference is not None
    figures = accuracy(run.result, run.reference)
    assert figures["kiss_icp_ate_m"] > 2 * figures["odometry_ate_m"]
    write_metrics(made.folder, run.metrics | figures)
    html = write_report(made.folder).read_text()
    plots = _plots(html)
    assert "KISS-ICP alone" in plots["Trajectory, top view and height"]
    errors = plots["Error along the drive, after alignment"]
    assert f"KISS-ICP alone, rms {figures['kiss_icp_ate_m']:.2f} m" in errors
    assert "odometry after repairs, rms" in errors
    assert number(figures["kiss_icp_ate_m"]) in html


def test_poses_of_kiss_icp_alone_of_other_scans_are_refused(tmp_path: Path) -> None:
    made = make_run(tmp_path / "run")
    later = replace(made.result.odometry, stamp_ns=made.result.odometry.stamp_ns + 1)
    write_poses(made.folder, ALONE, later, None)
    with pytest.raises(SegslamError, match=r"kiss_icp_tum\.txt: not of the scans of this run; remove the file"):
        read_run(made.folder)


@pytest.mark.long
def test_without_truth_nothing_is_compared_with_it(tmp_path: Path) -> None:
    html = write_report(make_run(tmp_path / "run", with_truth=False).folder).read_text()
    plots = _plots(html)
    assert "Error along the drive, after alignment" not in plots
    assert "truth" not in plots["Trajectory, top view and height"]
    assert "rejected by the optimiser (1)" in plots["Loops by outcome"]
    assert "error after alignment" not in html


def test_every_figure_is_in_the_table_with_its_meaning(scored: Path) -> None:
    html = scored.read_text()
    metrics = read_run(scored.parent).metrics
    for key in metrics:
        if key != "stage_ms" and not key.startswith("odometry_"):
            assert f"<code>{key}</code>" in html.replace("<wbr>", "")
    assert number(metrics["odometry_ate_m"]) in html
    assert FIGURES["ate_m"] in html


def test_every_reason_has_a_meaning() -> None:
    assert set(REASONS) == set(RejectReason)


def test_changed_settings_are_marked_and_shown_open(tmp_path: Path) -> None:
    run = read_run(make_run(tmp_path / "run").folder)
    assert '<tr class="changed">' not in _page(run, {})
    changed = _page(replace(run, config=load_config(None, ["keyframes.distance_m=1.25"])), {})
    assert re.search(
        r'<details open><summary>keyframes</summary>.*<tr class="changed"><td><code>distance_<wbr>m', changed
    )
    assert changed.count('<tr class="changed">') == 1
    for section in Config.model_fields:
        assert f"<summary>{section}</summary>" in changed


def test_the_angle_in_effect_is_changed_where_it_is_not_that_of_the_data(tmp_path: Path) -> None:
    run = read_run(make_run(tmp_path / "run").folder)
    for known, angle_deg, changed in ((True, 0.205, 0), (True, 0, 1), (False, 0, 0), (False, 0.205, 1)):
        config = load_config(None, [f"sensor.vertical_angle_deg={angle_deg}"])
        T_camera_lidar = run.T_camera_lidar if known else None
        html = _page(replace(run, config=config, T_camera_lidar=T_camera_lidar), {})
        assert html.count('<tr class="changed">') == changed
        assert html.count(f"sensor.vertical_angle_deg={angle_deg:.3g}") == changed


def test_names_are_not_taken_for_markup(tmp_path: Path) -> None:
    run = read_run(make_run(tmp_path / "run").folder)
    assert "<script>" not in _page(replace(run, dataset="<script>alert(1)</script>"), {"<script>": "<svg/>"})


@pytest.mark.long
def test_same_run_gives_the_same_page(scored: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(scored.parent, tmp_path / "run")
    assert write_report(folder).read_text() == scored.read_text()


def test_one_loop_is_in_the_singular(tmp_path: Path) -> None:
    run = read_run(make_run(tmp_path / "run").folder)
    for num_loops, text in ((1, "<b>1</b>loop accepted"), (2, "<b>2</b>loops accepted")):
        html = page(replace(run, metrics={"num_loops_accepted": num_loops}), {}, top="", gallery="", about={})
        assert text in html


def test_run_without_loops_is_drawn(tmp_path: Path) -> None:
    run = read_run(make_run(tmp_path / "run").folder)
    bare = replace(run, metrics={}, result=replace(run.result, attempts=()))
    html = _page(bare, {"Loops": draw_loops(bare)})
    assert "No pair of keyframes was proposed as a loop" in html
    assert html.count('id="words"') == 1
    assert "accepted" not in _plots(html)["Loops"]


def test_a_run_of_one_scan_has_no_empty_plot(tmp_path: Path) -> None:
    run = read_run(make_run(tmp_path / "run").folder)
    first = replace(
        run.result.trajectory,
        **{name: getattr(run.result.trajectory, name)[:1] for name in ("scan_index", "stamp_ns", "T_world_lidar")},
    )
    one = replace(run, result=replace(run.result, trajectory=first, attempts=(), keyframe_rows=np.zeros(1, np.int64)))
    assert "fill: #bbbbbb" in draw_loops(one)
    assert figures.draw_errors(one) is None


@pytest.mark.parametrize(("least_ms", "most_ms"), [(150.0, 4500.0), (1200.0, 36_000.0), (20_000.0, 24_000.0)])
def test_labels_of_times_do_not_overlap(monkeypatch: pytest.MonkeyPatch, least_ms: float, most_ms: float) -> None:
    drawn: list[Figure] = []
    monkeypatch.setattr(figures, "svg", lambda figure, name: drawn.append(figure) or name)
    with matplotlib.rc_context(figures.STYLE):
        figures.draw_stages(
            {"verify": {"median": least_ms, "p95": most_ms}, "map": {"median": least_ms, "p95": most_ms}}
        )
        drawn[0].draw_without_rendering()
    (axes,) = drawn[0].axes
    labels = [label for label in axes.get_xticklabels(which="both") if label.get_text()]
    spans = sorted((label.get_window_extent().x0, label.get_window_extent().x1) for label in labels)
    assert len(spans) > 2
    assert all(end < start for (_, end), (start, _) in pairwise(spans))


@pytest.mark.long
def test_folder_that_cannot_be_written_to_is_named(tmp_path: Path) -> None:
    folder = make_run(tmp_path / "run").folder
    (folder / "report.html").mkdir()
    with pytest.raises(SegslamError, match=r"report\.html: exists and is not a regular file"):
        write_report(folder)


def test_unfinished_run_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SegslamError, match="did not finish"):
        write_report(make_run(tmp_path / "run", finished=False).folder)


def test_command_writes_the_page_and_prints_its_path(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = make_run(tmp_path / "run").folder
    for arguments, status, expected in (
        (["report", str(folder)], 0, f"report written to {folder / 'report.html'}\n"),
        (["report", str(tmp_path / "nowhere")], 2, "nowhere: no such file or folder"),
    ):
        with pytest.raises(SystemExit) as ended:
            cli.main(arguments)
        assert int(ended.value.code or 0) == status
        assert expected in capsys.readouterr().err
    assert (folder / "report.html").stat().st_size > 10_000


@pytest.mark.long
def test_conditions_name_when_where_and_how_the_run_was_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.argv", ["/usr/bin/segslam", "map", "my_drive"])
    html = write_report(make_run(tmp_path / "run").folder).read_text()
    conditions = dict(re.findall(r"<tr><td>([^<]*)</td><td>([^<]*)</td></tr>", html.split("<h2>Conditions</h2>")[1]))
    assert abs(datetime.now(UTC) - datetime.fromisoformat(conditions["started (UTC)"])) < timedelta(hours=1)
    assert conditions["command"] == "segslam map my_drive"
    assert "cores" in conditions["processor"]
    assert conditions["settings other than the defaults"] == "none"
    assert settings_not_default(load_config(None, ["map.color=height"]), Config()) == "map.color=height"


def test_the_gallery_has_the_best_accepted_and_the_nearest_missed_loops(tmp_path: Path) -> None:
    run = read_run(make_run(tmp_path / "run").folder)
    loops = [attempt for attempt in run.result.attempts if attempt.candidate.source_id in (50, 51, 58)]
    chosen = choose(loops)
    assert [attempt.candidate.source_id for attempt in chosen] == [50, 58]  # 51, near 58, failed earlier
    assert (
        outcome_text(chosen[0], run.result.estimate.closure_weights)
        == "accepted, overlap 0.80, residual 0.10 m, weight 1.00"
    )
    assert outcome_text(chosen[1], run.result.estimate.closure_weights) == "rejected, low overlap (3 < 5)"


@pytest.mark.parametrize(
    ("value", "text"), [(2.3514, "2.35"), (0.33712, "0.337"), (23.14, "23.1"), (412.6, "413"), (7, "7")]
)
def test_numbers_have_three_digits(value: float, text: str) -> None:
    assert number(value) == text


def test_plots_have_whole_legends_and_plain_numbers(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    made = make_run(tmp_path / "run")
    run = read_run(made.folder)
    states = cycle((MotionState.REPAIRED, MotionState.BROKEN, MotionState.CONFIRMED))
    motions = tuple(replace(motion, state=state) for motion, state in zip(run.result.motions, states, strict=False))
    run = replace(run, result=replace(run.result, motions=motions, alone=run.result.odometry))
    with matplotlib.rc_context(figures.STYLE):
        plots = [figures.draw_paths(run), figures.draw_loops(run), figures.draw_loops_over_time(run)]
        errors = figures.draw_errors(run)
        assert errors is not None
        plots.append(errors)
        for longest_ms in (2.0, 100.0, 1e5):
            stages = {"a": {"median": 0.5, "p95": 1.0}, "b": {"median": 1.0, "p95": longest_ms}}
            plots.append(figures.draw_stages(stages))
    for plot in plots:
        width = float(plot.split('viewBox="0 0 ')[1].split()[0])
        words = re.findall(r'<text style="[^"]*" x="([\d.]+)"[^>]*>([^<]+)</text>', plot)
        assert len(words) > 4
        assert "$" not in "".join(word for _, word in words)
        assert sum(word.strip().strip("0.").isdigit() for _, word in words) > 1
        ends = {word: float(x) + 5 * len(word) for x, word in words if not word[0].isdigit()}
        assert max(ends.values()) <= width, ends


def test_the_title_of_a_pair_is_not_cut(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[Figure] = []

    def keep(*args: Any, **kwargs: Any) -> Figure:
        drawn.append(Figure(*args, **kwargs))
        return drawn[-1]

    monkeypatch.setattr(loops, "Figure", keep)
    title = "keyframes 1200 to 300: accepted, probability 1.0000 (" + "other pose -14.9, " * 6 + ")"
    loops.draw_pair(np.zeros((1, 3)), np.zeros((1, 3)), poses={"a": np.eye(4), "b": np.eye(4)}, title=title)
    (words,) = (text for text in drawn[0].texts if "keyframes" in text.get_text())
    assert " ".join(words.get_text().split()) == " ".join(title.split())
    extent = words.get_window_extent()
    assert 0 <= extent.x0 < extent.x1 <= drawn[0].bbox.x1


def test_a_phone_scrolls_wide_pictures_instead_of_shrinking_their_text(scored: Path) -> None:
    html = scored.read_text()
    assert re.search(r"@media \(max-width: 40rem\) \{[^@]*img\[src\*=\"image/png\"\] \{ width: 44rem; \}", html)
    assert "<p>Left: before, by odometry. Right: after, as mapped.</p><img" in html


@pytest.mark.parametrize("num_processes", [1, 2])
def test_the_program_of_the_top_view_is_packed_once_for_all_reports(
    num_processes: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not in the copy of this process that draws the pictures, where it would be lost."""
    monkeypatch.setattr(processes, "_num_processes", lambda: num_processes)
    loops.packed_plotly.cache_clear()
    make_run(tmp_path / "run")
    for _ in range(2):
        write_report(tmp_path / "run")
    assert loops.packed_plotly.cache_info().misses == 1
