"""The interactive top view of the report, as data and in a headless browser."""

import base64
import gzip
import html
import json
import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.finished_run import MadeRun, make_run

from segslam.core import geometry
from segslam.output.finished import read_run
from segslam.output.report import loops, write_report
from segslam.output.report.loops import MOST_SCANS, with_clouds

BROWSER = next((name for name in ("chromium", "chromium-browser", "google-chrome") if shutil.which(name)), None)
BROKEN = """<script>
document.body.style.cssText = "width: 400px; box-sizing: border-box";
for (const details of document.querySelectorAll("details")) details.open = true;
const words = [...document.querySelectorAll("td code")].flatMap(code => [...code.childNodes]).filter(node => {
  const range = document.createRange();
  range.selectNode(node);
  return node.data && !node.data.includes(" ") && new Set([...range.getClientRects()].map(box => box.top)).size > 1;
});
const found = words.map(node => node.data).join(" ") || "none";
document.body.dataset.broken = `${found}, width ${document.body.offsetWidth}`;
</script>"""
"""Notes words of keys that are on more than one line, at 400 pixels: the browser has no window below 500."""
CLICK = """<script>
const look = setInterval(() => {
  const view = document.getElementById("topview");
  if (!view.dataset.ready) return;
  clearInterval(look);
  const trace = view.data.findIndex((one) => one.name && one.name.startsWith("loops accepted"));
  view.emit("plotly_click", { points: [{ curveNumber: trace, pointNumber: 1 }] });
  const chooser = document.getElementById("colour");
  chooser.value = "height (m)";
  chooser.onchange();
}, 50);
</script>"""
"""Clicks on the second accepted loop, and colours the trajectory by height."""


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> MadeRun:
    run = make_run(tmp_path_factory.mktemp("made") / "run")
    write_report(run.folder)
    return run


def _data(page: str) -> dict[str, Any]:
    found = re.search(r'<script type="application/json" id="topview-data">(.*?)</script>', page, re.DOTALL)
    assert found is not None
    data: dict[str, Any] = json.loads(found[1])
    return data


def test_the_page_contains_the_drive_its_loops_and_their_clouds(made: MadeRun) -> None:
    page = (made.folder / "report.html").read_text()
    data = _data(page)
    run = read_run(made.folder)
    corrected = data["paths"][-1]
    assert corrected["name"] == "corrected"
    np.testing.assert_allclose(corrected["x"], run.result.trajectory.T_world_lidar[:, 0, 3], atol=0.006)
    assert set(data["values"]) == {"scan", "time (s)", "height (m)", "error (m)"}
    assert {len(values) for values in data["values"].values()} == {len(corrected["x"])}
    assert len(data["loops"]) == len(run.result.attempts)
    kinds = [loop["kind"] for loop in data["loops"]]
    assert (kinds.count("accepted"), kinds.count("rejected by the optimiser")) == (3, 1)
    loop = next(loop for loop in data["loops"] if loop["kind"] == "accepted")
    source_id, target_id = loop["pair"]
    T_world = run.result.estimate.T_world_keyframe
    expected = geometry.inverse(T_world[target_id]) @ T_world[source_id]
    np.testing.assert_allclose(np.reshape(loop["after"], (2, 4)), expected[:2], atol=1e-4)
    assert np.frombuffer(base64.b64decode(data["clouds"][str(source_id)]), "<i2").size % 3 == 0
    packed = re.search(r'id="plotly-packed">([^<]*)<', page)
    assert packed is not None
    assert gzip.decompress(base64.b64decode(packed[1])).startswith(b"/**\n* plotly.js")


def test_nothing_is_loaded_from_elsewhere_and_the_page_is_small(made: MadeRun) -> None:
    page = (made.folder / "report.html").read_text()
    assert not re.search(r"<(script|link|img)[^>]*(src|href)=\"(?!data:)", page)
    assert len(page) < 4e6


def test_text_of_a_run_cannot_end_the_script(made: MadeRun) -> None:
    run = read_run(made.folder)
    attempt = next(one for one in run.result.attempts if not one.outcome.ok)
    outcome = replace(attempt.outcome, detail="</script><b>")  # type: ignore[type-var]
    attempts = tuple(replace(one, outcome=outcome) if one is attempt else one for one in run.result.attempts)
    empty = np.empty((0, 3), np.float32), np.empty(0, np.uint8)
    page = loops.top_view(replace(run, result=replace(run.result, attempts=attempts)), lambda _: empty)
    assert "</script><b>" not in page
    assert any("</script><b>" in loop["text"] for loop in _data(page)["loops"])


def test_long_drives_are_thinned(made: MadeRun, monkeypatch: pytest.MonkeyPatch) -> None:
    run = read_run(made.folder)
    for most, num_accepted in ((3, 3), (6, 4), (100, 4)):
        monkeypatch.setattr(loops, "MOST_PAIRS", most)
        chosen = with_clouds(run)
        assert len(chosen) == min(most, 10)
        assert [one.outcome.ok for one in chosen] == [True] * num_accepted + [False] * (len(chosen) - num_accepted)
    for num in (1, MOST_SCANS, MOST_SCANS + 1, 3 * MOST_SCANS):
        assert 0 < len(loops._thinned(np.zeros((num, 3)), np.empty(0, np.int64))) <= MOST_SCANS


def _shown(page: str, folder: Path, *options: str) -> str:
    """The page as the browser has built it."""
    (folder / "page.html").write_text(page)
    command = [str(BROWSER), "--headless=new", "--no-sandbox", "--disable-gpu", "--virtual-time-budget=20000", *options]
    profile = f"--user-data-dir={folder / 'profile'}"
    done = subprocess.run(
        [*command, profile, "--dump-dom", f"file://{folder / 'page.html'}"], capture_output=True, text=True, check=True
    )
    return html.unescape(done.stdout)


@pytest.mark.skipif(BROWSER is None, reason="needs Chromium")
@pytest.mark.parametrize(("width", "has_buttons"), [(1400, True), (400, False)])
def test_buttons_do_not_cover_the_legend_on_a_phone(
    made: MadeRun, tmp_path: Path, width: int, has_buttons: bool
) -> None:
    shown = _shown((made.folder / "report.html").read_text(), tmp_path, f"--window-size={width},900")
    assert 'data-ready="yes"' in shown
    assert ('class="modebar-btn' in shown) == has_buttons


@pytest.mark.skipif(BROWSER is None, reason="needs Chromium")
def test_keys_are_broken_between_their_words_on_a_phone(made: MadeRun, tmp_path: Path) -> None:
    page = (made.folder / "report.html").read_text()
    shown = _shown(page.replace("</body>", f"{BROKEN}</body>"), tmp_path, "--window-size=400,900")
    assert 'data-broken="none, width 400"' in shown


@pytest.mark.skipif(BROWSER is None, reason="needs Chromium")
def test_a_click_on_a_loop_shows_its_two_clouds_before_and_after(made: MadeRun, tmp_path: Path) -> None:
    page = (made.folder / "report.html").read_text()
    shown = _shown(page.replace("</body>", f"{CLICK}</body>"), tmp_path)
    loops = [loop for loop in _data(page)["loops"] if loop["kind"] == "accepted"]
    assert f"<h3>keyframes {loops[1]['name']}: accepted, overlap" in shown
    assert shown.count('class="panel"') == 2
    for text in ("before: by odometry", "after: in the final map", "loops accepted (3)", "height (m)"):
        assert text in shown
    assert 'data-ready="yes"' in shown
