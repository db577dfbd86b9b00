"""One rule for all commands: what exists is replaced only with `--overwrite`."""

from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from helpers.commands import run
from helpers.drives import write_kitti_sequence
from helpers.finished_run import make_run

from segslam.cli.checks import make_folder
from segslam.core.errors import SegslamError
from segslam.core.whole_files import settle
from segslam.output.log import is_being_written, read_log
from segslam.output.log.writer import Output

GRAPH = """VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1
VERTEX_SE3:QUAT 1 1 0 0 0 0 0 1
EDGE_SE3:QUAT 0 1 1 0 0 0 0 0 1 1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1
"""


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = make_run(tmp_path_factory.mktemp("made") / "run").folder
    (folder / "graph.g2o").write_text(GRAPH)
    return folder


@pytest.mark.parametrize(
    "command",
    [
        ["export", "RUN", "FILE.png"],
        ["eval", "RUN", "--plot", "FILE.png"],
        ["compare", "RUN", "OTHER", "--plot", "FILE.png"],
        ["view", "RUN", "--save", "FILE.rrd"],
        ["optimize", "RUN/graph.g2o", "--out", "FILE.g2o"],
    ],
)
def test_a_file_is_replaced_only_if_wanted(
    command: list[str], made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    if command[0] == "view":
        pytest.importorskip("rerun")
    other = make_run(tmp_path / "other").folder if "OTHER" in command else made
    stem = str(tmp_path / "there")
    given = [part.replace("RUN", str(made)).replace("OTHER", str(other)).replace("FILE", stem) for part in command]
    file = Path(next(part for part in given if part.startswith(stem)))
    file.write_bytes(b"mine")
    assert run(*given, "--quiet") == 2
    assert f"{file}: exists; give another name, or replace it with --overwrite" in capsys.readouterr().err
    assert file.read_bytes() == b"mine"
    assert run(*given, "--overwrite", "--quiet") == 0
    assert file.read_bytes() != b"mine"


def test_two_results_are_not_written_into_one_file(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "table"
    assert run("eval", made, "--csv", file, "--latex", file) == 2
    assert f"{file}: given twice; give each file once" in capsys.readouterr().err
    assert not file.exists()


def test_the_image_of_a_grid_is_not_replaced_either(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "grid.pgm").write_bytes(b"mine")
    assert run("export", made, tmp_path / "grid.yaml", "--quiet") == 2
    assert "grid.pgm: exists" in capsys.readouterr().err
    assert (tmp_path / "grid.pgm").read_bytes() == b"mine"


@pytest.mark.usefixtures("short_runs")
def test_a_run_is_in_progress_until_its_report_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_kitti_sequence(tmp_path / "data", num_scans=3)
    states = []
    monkeypatch.setattr(
        "segslam.output.report.write_report", lambda folder: states.append(is_being_written(folder / "log.mcap"))
    )
    out = tmp_path / "run"
    assert run("map", tmp_path / "data", "--frames", "0:3", "--out", out, "--labels", "none", "--quiet") == 0
    assert states == [True]
    assert not is_being_written(out / "log.mcap")
    assert read_log(out).result() is not None


@pytest.mark.long
def test_map_replaces_a_run_only_if_wanted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data, out = tmp_path / "data", tmp_path / "run"
    write_kitti_sequence(data, num_scans=3)
    assert run("map", data, "--out", out, "--quiet") == 0
    (out / "notes.txt").touch()
    assert run("map", data, "--out", out, "--frames", "0:2", "--quiet") == 2
    assert "--overwrite" in capsys.readouterr().err
    assert (out / "notes.txt").exists()
    assert run("map", data, "--out", out, "--frames", "0:2", "--overwrite", "--quiet") == 0
    assert read_log(out / "log.mcap").num_steps() == 2
    assert not (out / "notes.txt").exists()
    assert run("map", data, "--out", out, "--overwrite", "--resume", "--quiet") == 2


def test_only_a_finished_run_that_is_no_input_is_removed(made: Path, tmp_path: Path) -> None:
    other = tmp_path / "photos"
    other.mkdir()
    (other / "me.jpg").touch()
    with pytest.raises(SegslamError, match="does not remove it"):
        make_folder(other, overwrite=True)
    (tmp_path / "link").symlink_to(made)
    with pytest.raises(SegslamError, match=f"link: a link, which --overwrite does not replace; give {made} itself"):
        make_folder(tmp_path / "link", overwrite=True)
    with pytest.raises(SegslamError, match="contains the input"):
        make_folder(made, overwrite=True, inputs=[made / "log.mcap"])
    with pytest.raises(SegslamError, match="not empty"):
        make_folder(made, overwrite=False)
    assert make_folder(tmp_path / "new", overwrite=True).is_dir()
    run_folder = tmp_path / "now"
    run_folder.mkdir()
    with closing(Output(run_folder / "log.mcap")), pytest.raises(SegslamError, match="in progress"):
        make_folder(run_folder, overwrite=True)
    assert (other / "me.jpg").exists()
    assert (made / "log.mcap").exists()


@pytest.mark.parametrize(
    "command",
    [
        ["simulate", "OUT", "--frames", "1"],
        ["label", "DATA", "--labels", "geometric", "--out", "OUT", "--overwrite"],
        ["bench", "pairs", "DATA", "--out", "OUT"],
        ["fleet", "DATA", "--out", "OUT"],
        ["sweep", "RUN", "--set", "verify.max_false_share=0.1", "--out", "OUT"],
    ],
)
def test_a_folder_with_other_content_is_not_written_into(
    command: list[str], made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "report.html").write_text("mine")
    paths = {"OUT": tmp_path / "photos", "RUN": made, "DATA": made}
    assert run(*(paths.get(word, word) for word in command), "--quiet") == 2
    assert "photos: not empty, and not made by this command; give another folder" in capsys.readouterr().err
    assert [file.name for file in (tmp_path / "photos").iterdir()] == ["report.html"]


def test_only_a_run_can_be_continued(made: Path, tmp_path: Path) -> None:
    with pytest.raises(SegslamError, match=r"not empty; .*, continue an interrupted run: segslam resume, or replace"):
        make_folder(made, overwrite=False)
    (tmp_path / "000000.label").touch()
    with pytest.raises(SegslamError, match=r"not empty; .*, or replace results of this command: --overwrite"):
        make_folder(tmp_path, overwrite=False, made_by=("*.label",))


def test_a_merged_run_cannot_replace_its_input_and_this_is_found_at_once(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("segslam.run.sessions.merge.plan", None)  # which registers the runs
    other = make_run(tmp_path / "other").folder
    assert run("merge", made, other, "--out", other, "--overwrite", "--quiet") == 2
    assert f"{other}: contains the input {other}" in capsys.readouterr().err
    assert (other / "log.mcap").exists()


@pytest.mark.parametrize("is_made", [False, True])
def test_a_run_that_a_killed_command_set_aside_is_back_at_the_next_start(tmp_path: Path, is_made: bool) -> None:
    out = make_run(tmp_path / "run").folder
    for overwrite in (True, False):
        out.rename(tmp_path / ".run.replaced")
        if is_made:
            out.mkdir()
        if overwrite:
            assert list(make_folder(out, overwrite=True).iterdir()) == []
            settle()  # nothing was made instead
        else:
            with pytest.raises(SegslamError, match="run: not empty"):
                make_folder(out, overwrite=False)
        assert [file.name for file in tmp_path.iterdir()] == ["run"]
        assert (out / "log.mcap").exists()


def test_a_run_is_not_lost_if_the_new_one_maps_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out, data = make_run(tmp_path / "run").folder, tmp_path / "data"
    before = {file.name: file.read_bytes() for file in out.iterdir()}
    data.mkdir()
    for number in range(3):
        np.zeros((9, 4), np.float32).tofile(data / f"{number}.bin")
    assert run("map", data, "--out", out, "--overwrite", "--quiet") == 2
    assert "none of 3 scans could be used" in capsys.readouterr().err
    assert {file.name: file.read_bytes() for file in out.iterdir()} == before
    assert sorted(file.name for file in tmp_path.iterdir()) == ["data", "run"]
    monkeypatch.chdir(out)
    assert run("map", data, "--out", ".", "--overwrite", "--quiet") == 2
    assert "holds the present folder" in capsys.readouterr().err
    assert {file.name: file.read_bytes() for file in out.iterdir()} == before
