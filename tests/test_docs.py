"""The documents match the code: examples run, the options page is up to date, commands have help texts."""

import json
import re
import runpy
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import pytest
from helpers.commands import all_commands, run
from helpers.drives import round_drive, write_kitti_sequence
from helpers.finished_run import make_run
from helpers.gnss_drive import write_fixes
from helpers.sessions import write_day
from typer.main import get_command

import segslam
from segslam import cli
from segslam.cli import commands
from segslam.core.config import Config
from segslam.core.pose_files import read_poses
from segslam.core.types import RejectReason
from segslam.output.log import schema
from segslam.scans import open_dataset

ROOT = Path(__file__).resolve().parents[1]
EXAMPLES = ROOT / "docs" / "examples"
GENERATED = {"commands.md", "api.md"}
PAGES = [
    *("README.md", "CONTRIBUTING.md", "CHANGELOG.md"),
    *(f"docs/{file.name}" for file in (ROOT / "docs").glob("*.md") if file.name not in GENERATED),
]


def _run_example(monkeypatch: pytest.MonkeyPatch, name: str, *arguments: Path) -> None:
    monkeypatch.setattr(sys, "argv", [name, *map(str, arguments)])
    runpy.run_path(str(EXAMPLES / name), run_name="__main__")


def test_the_example_that_maps_writes_a_pose_a_scan(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write_kitti_sequence(tmp_path / "kitti", num_scans=5)
    _run_example(monkeypatch, "map_scans.py", tmp_path / "kitti", tmp_path / "poses.txt")
    assert len(read_poses(tmp_path / "poses.txt")) == 5
    assert "5 poses in" in capsys.readouterr().out


def test_the_python_of_the_readme_skips_a_scan_that_cannot_be_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    velodyne = write_kitti_sequence(tmp_path / "FOLDER", num_scans=4)
    np.full((500, 4), 900.0, dtype=np.float32).tofile(velodyne / "000002.bin")  # beyond the range
    monkeypatch.chdir(tmp_path)
    [block] = re.findall(r"(?s)```python\n(.*?)```", (ROOT / "README.md").read_text(encoding="utf-8"))
    points = np.zeros((0, 3))
    names: dict[str, Any] = {"source_points": points, "target_points": points}
    exec(compile(block, "README.md", "exec"), names)
    assert names["result"].trajectory.scan_index.tolist() == [0, 1, 3]
    assert "skipped: scan 2" in capsys.readouterr().out


def test_the_example_that_registers_finds_the_pose(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    scans, truth = round_drive()
    files = [tmp_path / "source.npy", tmp_path / "target.npy"]
    for file, scan in zip(files, (scans[53], scans[2]), strict=True):
        np.save(file, scan.points)
    _run_example(monkeypatch, "register_scans.py", *files)
    shown = np.array([float(value) for value in re.findall(r"-?\d+\.\d*", capsys.readouterr().out)][1:]).reshape(4, 4)
    T_target_source = np.linalg.inv(truth.T_world_lidar[2]) @ truth.T_world_lidar[53]
    np.testing.assert_allclose(shown[:3, 3], T_target_source[:3, 3], atol=0.3)


def test_the_example_that_reads_a_log_counts_its_loops(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    _run_example(monkeypatch, "read_log.py", make_run(tmp_path / "run").folder)
    output = capsys.readouterr().out
    assert "'accepted': 4" in output
    assert "120 scans; keyframe 59 has 4 points" in output


@pytest.mark.data
def test_the_example_that_scores_agrees_with_the_known_error(
    data_dir: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    estimate = next((data_dir / "trajectories").glob("KITTI_00_ORB*"))
    _run_example(monkeypatch, "score_trajectory.py", estimate, data_dir / "kitti" / "poses" / "00.txt")
    [ate] = re.findall(r"ate_m +(\d+\.\d+)", capsys.readouterr().out)
    assert float(ate) == pytest.approx(1.30, abs=0.005)  # as the data's description has it


def _code_cells() -> list[dict[str, Any]]:
    cells = json.loads((ROOT / "docs" / "tutorial.ipynb").read_text(encoding="utf-8"))["cells"]
    return [cell for cell in cells if cell["cell_type"] == "code"]


def test_the_notebook_has_the_outputs_of_its_cells_in_order() -> None:
    cells = _code_cells()
    assert [cell["execution_count"] for cell in cells] == list(range(1, len(cells) + 1))
    kinds = {kind for cell in cells for output in cell["outputs"] for kind in output.get("data", {})}
    assert {"image/png", "text/html"} <= kinds
    assert not [output for cell in cells for output in cell["outputs"] if output["output_type"] == "error"]
    assert (ROOT / "docs" / "tutorial.ipynb").stat().st_size < 600_000


@pytest.mark.slow
@pytest.mark.data
def test_the_notebook_gives_the_errors_that_it_shows(
    data_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SEGSLAM_DATA", str(data_dir.resolve()))
    matplotlib.use("Agg")
    names: dict[str, Any] = {}
    cells = _code_cells()
    for cell in cells:
        exec(compile("".join(cell["source"]), cell["id"], "exec"), names)  # as a kernel does
    plt.close("all")
    shown = "".join("".join(output.get("text", [])) for cell in cells for output in cell["outputs"])
    for name in ("kiss_icp_ate_m", "odometry_ate_m", "ate_m"):
        [figure] = re.findall(rf"(?m)^{name} +(\S+)$", shown)
        assert names["run"].metrics[name] == pytest.approx(float(figure), abs=0.02), name
    [off_m] = re.findall(r"the pose is (\S+) m off", shown)
    assert names["off_m"] == pytest.approx(float(off_m), abs=0.05)


@pytest.mark.slow
def test_the_examples_of_the_public_names_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monday = write_day(tmp_path / "monday", day=0, first=0, num_scans=22)
    write_day(tmp_path / "tuesday", day=1, first=6, num_scans=22)
    truth = open_dataset(monday).reference
    assert truth is not None
    write_fixes(tmp_path / "fixes.csv", truth.stamp_ns, truth.T_world_lidar)
    monkeypatch.chdir(tmp_path)
    names = runpy.run_path(str(EXAMPLES / "api.py"))
    assert names["found"].ok
    assert not names["nothing"].ok
    assert isinstance(names["pose"], segslam.Located)
    assert names["second"].metrics["localised_percent"] > 50
    assert names["both"].metrics["num_loops_between"] > 0
    assert names["figures"]["ate_m"] < 0.5
    assert (tmp_path / "map.png").is_file()


@pytest.mark.data
def test_the_table_of_the_page_about_kitti_is_the_output_of_its_command(
    data_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("00", "05", "07"):
        shutil.copy(data_dir / "trajectories" / f"simple_online_{name}.txt", tmp_path / f"{name}.txt")
    assert run("eval", "--estimate", tmp_path, "--reference", data_dir / "kitti" / "poses") == 0
    page = (ROOT / "docs" / "kitti.md").read_text(encoding="utf-8")
    shown = capsys.readouterr().out.strip("\n").splitlines()
    assert "\n".join(f"    {line}" for line in shown) in page


def test_every_public_name_has_an_example() -> None:
    examples = runpy.run_path(str(ROOT / "tools" / "reference_pages.py"))["api_examples"]()
    assert set(examples) == set(segslam.__all__)
    assert all("segslam." in text or name == "Located" for name, text in examples.items())


def test_the_site_lists_the_commands_in_the_groups_and_order_of_the_help() -> None:
    page = runpy.run_path(str(ROOT / "tools" / "reference_pages.py"))["commands_page"]()
    shown = re.findall(r"^## segslam ([\w-]+)", page, re.MULTILINE)
    named = [name for group in commands.GROUPS.values() for name in group]
    assert [name for name in shown if name != "bench"] == named
    assert re.findall(r"^\*\*([^*]+)\*\*$", page, re.MULTILINE) == list(commands.GROUPS)


def test_the_container_has_the_libraries_of_the_install_page_and_copies_what_the_build_needs() -> None:
    container = (ROOT / "Dockerfile").read_text()
    [wanted] = re.findall(r"apt-get install (.*) python3-venv", (ROOT / "docs" / "install.md").read_text())
    assert wanted in container
    for copied in re.findall(r"^COPY (.*) /src", container, re.MULTILINE)[0].split():
        assert (ROOT / copied).is_file()


def test_the_site_has_a_page_for_every_command_and_public_name() -> None:
    pages = runpy.run_path(str(ROOT / "tools" / "reference_pages.py"))
    page = pages["commands_page"]()
    for name, command in all_commands(get_command(cli.app)):
        assert f"## segslam {name}\n" in page
        shown = [parameter for parameter in command.params if not getattr(parameter, "hidden", False)]
        assert all(f"`{option}`" in page for one in shown for option in one.opts if "-" in option)
    assert all(f"## {name}\n" in pages["api_page"]() for name in segslam.__all__ if callable(getattr(segslam, name)))


def test_the_page_of_commands_has_defaults_of_zero_and_no_empty_ones() -> None:
    page = runpy.run_path(str(ROOT / "tools" / "reference_pages.py"))["commands_page"]()
    assert "| `--lane` | `0.0` |" in page
    assert "| `--draw` | `0` |" in page
    assert "| `--topic` |  |" in page


def test_the_page_of_files_has_every_topic_of_a_log() -> None:
    texts = [value for name, value in vars(schema).items() if name.isupper() and isinstance(value, str)]
    topics = {text for text in texts if text.startswith("/")}
    page = (ROOT / "docs" / "files.md").read_text(encoding="utf-8")
    assert len(topics) > 15
    assert not {topic for topic in topics if f"`{topic}`" not in page}


def test_the_glossary_has_every_reason_and_the_page_is_that_of_the_program() -> None:
    page = runpy.run_path(str(ROOT / "tools" / "reference_pages.py"))["glossary_page"]()
    assert (ROOT / "docs" / "glossary.md").read_text(encoding="utf-8") == page
    assert all(f"| `{reason}` |" in page for reason in RejectReason)


@pytest.mark.slow
def test_the_site_is_built_without_warnings(tmp_path: Path) -> None:
    build = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", str(ROOT / "docs"), str(tmp_path / "site")]
    done = subprocess.run(build, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "site" / "tutorial.html").is_file()


def test_every_example_is_run_by_a_test_here() -> None:
    tests = Path(__file__).read_text()
    assert all(f'"{example.name}"' in tests for example in EXAMPLES.glob("*.py"))


def test_the_page_of_options_is_that_of_the_configuration() -> None:
    page = runpy.run_path(str(ROOT / "tools" / "options.py"))["page"]
    assert (ROOT / "docs" / "options.md").read_text(encoding="utf-8") == page(), "run: python tools/options.py"


def test_commands_are_added_once_however_many_are_run() -> None:
    for _ in range(2):
        commands.add(cli.app)
    names = [command.name for command in cli.app.registered_commands]
    assert len(names) == len(set(names)) > 20


def test_every_command_has_an_example_and_every_option_is_explained() -> None:
    commands.add(cli.app)
    whole = get_command(cli.app)
    groups = [whole, *(command for command in whole.commands.values() if hasattr(command, "commands"))]
    assert len(groups) == 2  # the bench
    for group in groups:
        assert "Example: segslam" in group.help, group.name
        lines = [command.get_short_help_str(62) for command in group.commands.values()]
        assert not [line for line in lines if line.endswith("...")]
    for name, command in all_commands(whole):
        assert "Example" in (command.help or ""), f"segslam {name}"
        for parameter in command.params:
            assert getattr(parameter, "help", None), f"segslam {name}: {parameter.name}"


def test_help_starts_without_the_heavy_packages() -> None:
    code = (
        "import sys; from segslam.cli import main\n"
        "try: main(['--help'])\n"
        "except SystemExit: pass\n"
        "print(sorted({'numpy', 'scipy', 'open3d', 'gtsam', 'numba', 'matplotlib', 'pydantic'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"


@pytest.mark.parametrize("page", PAGES)
def test_the_commands_and_options_that_a_page_names_exist(page: str) -> None:
    commands.add(cli.app)
    known = dict(all_commands(get_command(cli.app)))
    for line in re.findall(r"(?m)^(?:    |\$ )segslam .*$|`segslam [^`]*`", (ROOT / page).read_text()):
        words = line.strip(" `$").split("#")[0].split()
        name = " ".join(words[1:3]) if " ".join(words[1:3]) in known else words[1] if len(words) > 1 else ""
        if name.startswith("-") or not name:
            continue
        assert name in known or name == "bench", f"{page}: {line}"
        options = {option for parameter in known[name].params for option in parameter.opts} if name in known else set()
        for word in words:
            if word.startswith("--") and options:
                assert word.split("=")[0] in options | {"--help"}, f"{page}: {line}"


@pytest.mark.parametrize("page", PAGES)
def test_a_page_has_one_title(page: str) -> None:
    """The site lists each heading of the first level as a page of its own."""
    text = re.sub(r"(?ms)^```.*?^```", "", (ROOT / page).read_text())
    assert len(re.findall(r"(?m)^# ", text)) == 1, page


@pytest.mark.parametrize("page", PAGES)
def test_the_files_that_a_page_links_to_exist(page: str) -> None:
    for target in re.findall(r"\]\(([^)#]+)\)", (ROOT / page).read_text()):
        assert target.startswith("http") or ((ROOT / page).parent / target).exists(), f"{page}: {target}"


def _defaults(section: str) -> list[tuple[str, float]]:
    """Name and default of each number of a section of the settings."""
    values = getattr(Config(), section).model_dump()
    return [
        (name, number)
        for name, value in values.items()
        for number in (value if isinstance(value, tuple) else (value,))
        if isinstance(number, int | float) and not isinstance(number, bool)
    ]


@pytest.mark.parametrize("section", ["proximity", "verify", "refine", "graph", "health"])
def test_the_page_of_thresholds_gives_each_setting_with_its_default(section: str) -> None:
    page = (ROOT / "docs" / "decisions.md").read_text(encoding="utf-8")
    rows = [line for line in page.splitlines() if line.startswith("| ")]
    for name, number in _defaults(section):
        named = " ".join(row for row in rows if re.search(rf"[`.]{name}`", row))
        shown = {f"{number:g}", f"{100 * number:g} %"}
        assert any(re.search(rf"(?<![\d.]){re.escape(text)}(?![\d.]*\d)", named) for text in shown), (name, number)


def test_the_errors_of_real_drives_are_those_that_the_benchmark_wrote() -> None:
    drives = json.loads((ROOT / "docs" / "real_drives.json").read_text())["drives"]
    table = (ROOT / "docs" / "benchmarks.md").read_text().split("## Whole drives, real")[1].split("\n\n")[2]
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in table.splitlines()[2:]]
    assert len(rows) == len(drives)
    for row, drive in zip(rows, drives, strict=True):
        kiss, before, after = (drive.get(key) for key in ("kiss_icp_ate_m", "odometry_ate_m", "ate_m"))
        assert row[0].startswith(drive["drive"])
        assert row[1:6] == [
            *(str(drive["scans"]), f"{kiss:.2f}" if kiss else ""),
            *(f"{before:.2f}", f"{after:.2f}", str(drive["num_motions_repaired"])),
        ]
    readme = (ROOT / "README.md").read_text()
    whole = drives[0]
    for value in (f"error {whole['kiss_icp_ate_m']:.2f} m", f"error is {whole['ate_m']:.2f} m"):
        assert value in readme
    for drive in (
        drive for drive in drives if drive["drive"] in ("KITTI 00 whole", "NCLT whole", "HKU 1", "courtyard")
    ):
        errors = ", ".join(f"{drive[key]:.2f}" for key in ("kiss_icp_ate_m", "odometry_ate_m", "ate_m"))
        assert errors in readme, drive["drive"]
