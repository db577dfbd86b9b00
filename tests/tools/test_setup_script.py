"""`tools/setup.sh` chooses an interpreter that segslam supports, or prints what to install."""

import subprocess
import sys
from pathlib import Path

SCRIPT = Path(__file__).resolve().parents[2] / "tools" / "setup.sh"
FUTURE = '#!/bin/sh\n[ "$1" = --version ] && { echo Python 3.14.0; exit 0; }\nexit 1\n'
"""A python3 that is too new: the check of its version fails."""


def _sourced(folder: Path, call: str) -> subprocess.CompletedProcess[str]:
    """The functions of the script, one of them called, with only these interpreters on the path."""
    functions = SCRIPT.read_text().partition("\nsystem_packages && ")[0].replace("${BASH_SOURCE[0]}", str(SCRIPT))
    for name in ("dirname", "cat", "sha256sum", "grep"):
        (folder / name).symlink_to(f"/usr/bin/{name}")
    environment = {"PATH": str(folder), "SEGSLAM_VENV": str(folder / "venv")}
    command = ["/bin/bash", "-c", f"{functions}\n{call}", "setup", ""]
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=False)


def _write(file: Path, text: str) -> None:
    file.write_text(text)
    file.chmod(0o755)


def test_an_older_interpreter_is_taken_where_python3_is_too_new(tmp_path: Path) -> None:
    _write(tmp_path / "python3", FUTURE)
    _write(tmp_path / "python3.12", f'#!/bin/sh\nexec {sys.executable} "$@"\n')
    ended = _sourced(tmp_path, "find_python; echo $python")
    assert ended.stdout.split() == ["python3.12"], ended.stderr


def test_without_an_interpreter_the_message_has_the_package_to_install(tmp_path: Path) -> None:
    _write(tmp_path / "python3", FUTURE)
    ended = _sourced(tmp_path, "python_packages")
    assert ended.returncode == 1
    assert "Python 3.14.0 is what there is" in ended.stderr
    assert "Install python3.13" in ended.stderr
    assert not (tmp_path / "venv").exists()


def test_installed_libraries_are_found_in_a_long_list(tmp_path: Path) -> None:
    names = [f"{name}.so.{number}" for name, number in (("libusb-1.0", 0), ("libGL", 1), ("libEGL", 1), ("libgomp", 1))]
    listed = "\\n".join([*names, *("libother.so => /lib/libother.so" for _ in range(5000))])
    _write(tmp_path / "ldconfig", f"#!/bin/bash\nfor part in 1 2 3 4 5 6 7 8; do printf '{listed}\\n'; done\n")
    _write(tmp_path / "python3", f'#!/bin/sh\nexec {sys.executable} "$@"\n')
    ended = _sourced(tmp_path, "set -o pipefail; install_packages() { echo installing $*; }; system_packages")
    assert (ended.returncode, ended.stdout) == (0, ""), ended.stderr
