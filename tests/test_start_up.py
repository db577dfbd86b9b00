"""Imports before the first message of a command: large libraries are imported only where they are used."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

HEAVY = {"open3d", "scipy", "gtsam", "matplotlib", "numba", "kiss_icp", "small_gicp", "mcap", "rerun", "onnxruntime"}
"""Each takes a tenth of a second to import, or several seconds."""
SHOW = "import json, sys; print(json.dumps(sorted(sys.modules)), file=sys.stderr)"


def _imported(*arguments: str) -> tuple[int, set[str], str]:
    """Exit status of `segslam`, the packages that were imported when it ended, and what it wrote."""
    code = f"import atexit; atexit.register(lambda: exec({SHOW!r})); from segslam.cli import main; main({arguments!r})"
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    written, modules = ended.stderr.rstrip().rpartition("\n")[::2]
    return ended.returncode, set(json.loads(modules)), ended.stdout + written


@pytest.mark.parametrize("arguments", [("--help",), ("-h",), ("map", "--help"), ("--version",)])
def test_help_and_version_import_no_library_but_typer(arguments: tuple[str, ...]) -> None:
    status, modules, text = _imported(*arguments)
    assert status == 0
    assert "segslam" in text
    assert not modules & (HEAVY | {"numpy", "yaml", "rich.markdown"})


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("map", "nowhere", "--out", "r"), "nowhere: no such file"),
        (("map", ".", "--out", "r", "--set", "odometry.size=1"), "unknown key odometry.size"),
        (("map", ".", "--outt", "r"), "No such option"),
        (("register", "nowhere.bin", "there.bin"), "nowhere.bin: no such file"),
        (("replay", "nowhere", "--out", "r"), "nowhere: no such file"),
        (("replay", ".", "--out", "r", "--set", "odometry.size=1"), "unknown key odometry.size"),
    ],
)
def test_a_wrong_option_file_or_setting_is_reported_before_large_libraries_are_imported(
    arguments: tuple[str, ...], message: str
) -> None:
    status, modules, text = _imported(*arguments)
    assert status == 2
    assert message in text
    assert not modules & HEAVY


def test_the_process_that_aligns_scans_imports_no_large_library_but_kiss_icp() -> None:
    code = "import json, sys; import segslam.odometry.aligner; print(json.dumps(sorted(sys.modules)))"
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert set(json.loads(ended.stdout)) & HEAVY == {"kiss_icp"}


def test_runs_are_read_and_begun_without_the_statistics_of_scipy() -> None:
    """A third of a second; of the functions there, one is needed, at the end of a run."""
    code = "import json, sys; import segslam.output.finished, segslam.run.run; print(json.dumps(sorted(sys.modules)))"
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "scipy.stats" not in json.loads(ended.stdout)


FIRST_WORD = """
import io, os, sys, json
from segslam.cli import main

class Terminal(io.StringIO):
    def isatty(self):
        return True
    def write(self, text):
        if not text:
            return
        os.write(1, json.dumps([text, sorted(sys.modules)]).encode() + b"\\n")
        os._exit(0)

for command in json.loads(sys.argv[1]):
    if os.fork() == 0:
        sys.stderr = Terminal()
        main(command)
    os.wait()
"""
"""Each command until it writes to its terminal, in a copy of a process that has only loaded the command line."""


def test_every_long_command_prints_a_message_before_it_imports_large_libraries(tmp_path: Path) -> None:
    folder, file = str(tmp_path), str(tmp_path / "there.bin")
    Path(file).touch()
    commands = [
        ["map", folder, "--out", file],
        ["map", folder, "--dry-run"],
        ["replay", folder, "--out", file],
        ["resume", folder],
        ["eval", folder],
        ["eval", "--estimate", file, "--reference", file],
        ["report", folder],
        ["view", folder, "--save", f"{folder}/run.rrd"],
        ["export", folder, f"{folder}/map.ply"],
        ["register", file, file],
        ["simulate", f"{folder}/drive"],
        ["demo", "--out", folder],
        ["optimize", file, "--out", f"{folder}/out.g2o"],
        ["label", folder, "--labels", "geometric", "--out", file],
        ["calibrate", folder],
        ["live", folder, "--out", file],
        ["compare", folder, str(tmp_path.parent)],
        *(["bench", kind, folder] for kind in ("pairs", "timing", "yaw", "deterioration")),
    ]
    started = [sys.executable, "-c", FIRST_WORD, json.dumps(commands)]
    shown = subprocess.run(started, capture_output=True, text=True, check=True).stdout.splitlines()
    assert len(shown) == len(commands), shown
    for command, (text, modules) in zip(commands, map(json.loads, shown), strict=True):
        assert text.startswith(f"{command[0]}: "), (command, text)
        assert not HEAVY & set(modules), command


@pytest.mark.long
def test_registering_two_scans_loads_neither_the_baselines_nor_the_graph(data_dir: Path) -> None:
    scans = [str(data_dir / "kitti" / "sequences" / "00" / "velodyne" / f"00000{k}.bin") for k in (0, 2)]
    status, modules, text = _imported("register", *scans, "--dataset", "kitti")
    assert status == 0, text
    assert not modules & {"open3d", "gtsam", "matplotlib", "kiss_icp", "mcap", "scipy.stats", "pandas", "dash"}
