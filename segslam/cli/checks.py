"""Checks before a command begins: its input exists, a run can be resumed, nothing is replaced unasked; presets."""

import shlex
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, cast

from segslam.cli.console import Terminal
from segslam.cli.dry_run import first_usable
from segslam.cli.options import Settings
from segslam.core.errors import SegslamError
from segslam.core.whole_files import check_target, set_aside, settle

if TYPE_CHECKING:
    from segslam.core.config import Config
    from segslam.output.log import RunLog
    from segslam.scans import Dataset
    from segslam.scans.presets import Preset


def check_exists(path: Path, hint: str) -> None:
    """Raises SegslamError with the hint if the path does not exist; called before large libraries are imported."""
    if not path.expanduser().exists():
        raise SegslamError(f"{path}: no such file or folder; {hint}")


def check_scans(data: Path) -> None:
    """Raises SegslamError if there is no such data."""
    check_exists(data, "give the folder with sequences/ or with the scans")


def check_run(run: Path) -> None:
    """Raises SegslamError if there is no such run."""
    check_exists(run, "give a run folder, or its log.mcap")


def check_free(files: Iterable[Path | None], *, overwrite: bool, inputs: Iterable[Path | None] = ()) -> None:
    """Raises SegslamError if one of the files to write exists, unless `overwrite` is set, or cannot be written.

    Also for a file that is given twice, or that is one of the `inputs`. A grid (.yaml) has two files.
    """
    read = {path.resolve() for path in inputs if path is not None}
    given = [file for file in files if file is not None]
    if twice := [file for row, file in enumerate(given) if file in given[:row]]:
        raise SegslamError(f"{twice[0]}: given twice; give each file once")
    for file in (*given, *(file.with_suffix(".pgm") for file in given if file.suffix.lower() == ".yaml")):
        check_target(file)
        if file.is_file() and not overwrite:
            raise SegslamError(f"{file}: exists; give another name, or replace it with --overwrite")
        if file.resolve() in read:
            raise SegslamError(f"{file}: is an input of this command; give another name")


def outside(files: Iterable[Path], folder: Path) -> list[Path]:
    """The files that are not in a folder, whatever `..` and links their paths have; in full."""
    inside = folder.resolve()
    return [file.parent.resolve() / file.name for file in files if inside not in file.resolve().parents]


def check_own(folder: Path, *made_by: str) -> None:
    """Raises SegslamError for a folder with other content than that of this command: no name matches `made_by`."""
    if folder.is_dir() and any(folder.iterdir()) and not any(any(folder.glob(name)) for name in made_by):
        raise SegslamError(f"{folder}: not empty, and not made by this command; give another folder")


def check_not_read(folder: Path, inputs: Iterable[Path | None]) -> None:
    """Raises SegslamError for an existing folder with content that is inside an input, or contains one."""
    if not folder.is_dir() or not any(folder.iterdir()):
        return
    for path in inputs:
        if path is not None and path.exists() and (_holds(folder, path) or _holds(path, folder)):
            raise SegslamError(f"{folder}: inside the input {path}, or contains it; give another --out")


def _holds(folder: Path, path: Path) -> bool:
    """True if a path is a folder or lies in it, whatever links there are."""
    return path.resolve().is_relative_to(folder.resolve())


def make_folder(
    folder: Path,
    *,
    overwrite: bool,
    inputs: Iterable[Path | None] = (),
    made_by: tuple[str, ...] = ("log.mcap", "log.mcap.part"),
) -> Path:
    """Create the folder of a new run, as `new_folder`; with `overwrite` an earlier run there is replaced.

    It is removed with the first step of the new one, or at the end of the command, which puts it back if nothing was
    made instead.

    Raises SegslamError for a folder that is no run (no name matches `made_by`), for a run in progress, and if the new
    run is made from files in it.
    """
    from segslam.output.folder import new_folder
    from segslam.output.log import is_being_written

    if not folder.is_dir() or not any(folder.iterdir()):
        settle(folder)  # puts back what a killed command had set aside
    if not overwrite or not folder.is_dir() or not any(folder.iterdir()):
        return new_folder(folder)
    if folder.is_symlink():
        raise SegslamError(f"{folder}: a link, which --overwrite does not replace; give {folder.resolve()} itself")
    logs = [file for name in made_by for file in folder.glob(name)]
    if not logs:
        raise SegslamError(f"{folder}: not made by this command, so --overwrite does not remove it; give another --out")
    for path in inputs:
        if path is not None and _holds(folder, path):
            raise SegslamError(f"{folder}: contains the input {path}; give another --out")
    if any(log.is_file() and is_being_written(log) for log in logs):
        raise SegslamError(f"{folder}: the run is still in progress; stop it, or give another --out")
    if _holds(folder, Path.cwd()):
        raise SegslamError(f"{folder}: holds the present folder; change to another one, or give another --out")
    set_aside(folder)
    return new_folder(folder)


def remove_if_empty(folder: Path) -> None:
    """Remove the folder of a run that did not begin."""
    with suppress(OSError):
        folder.rmdir()


def check_links(folder: Path) -> None:
    """Raises SegslamError if a file in the folder of a run is a link to outside: writing it would write there."""
    for file in folder.iterdir() if folder.is_dir() else ():
        if file.is_symlink() and outside([file], folder):
            raise SegslamError(f"{file}: a link to {file.resolve()}, outside of the run; remove the link")


def log_to_resume(folder: Path) -> "RunLog":
    """The log of the run in a folder. Raises SegslamError if there is none, or the run is still in progress."""
    from segslam.output.folder import LOG
    from segslam.output.log import is_being_written, read_log

    check_links(folder)
    log = folder / LOG
    if not log.is_file():
        raise SegslamError(
            f"{folder}: contains no {LOG}, so there is no run to resume; map into a new folder without --resume"
        )
    if is_being_written(log):
        raise SegslamError(f"{log}: the run is still in progress; stop it before you resume it")
    return read_log(log)


def why_not_resumed(options: Mapping[str, str], run: Path) -> str:
    """Why `segslam resume` refuses a run with these options in its log, and the remedy; empty if it does not."""
    if options.get("live"):
        again = f"segslam replay {shlex.quote(str(run))} --out NEW"
        return f"a live run cannot be resumed, because its scans were not stored; to make its results: {again}"
    if options.get("sessions"):
        return "of merged runs; merge them again into a new folder"
    if own := options.get("python"):
        return f"made from Python with its own {own}; map the data again from there"
    return ""


def check_same(recorded: "RunLog", settings: "Config", *, dataset: str, options: Mapping[str, str]) -> None:
    """Raises SegslamError if a run would be resumed with other data, settings or options."""
    from segslam.core.config import changed_settings

    for key, before, now in changed_settings(recorded.config, settings):
        raise SegslamError(
            f"{key}: {now} now, but {recorded.path} was started with {before}; a resumed run keeps its settings"
        )
    compared = [("data set", recorded.run.get("dataset", ""), dataset)]
    compared += [(f"--{name}", recorded.options.get(name, ""), value) for name, value in options.items()]
    for name, began, given in compared:
        if began != given:
            raise SegslamError(
                f"{name}: {given or 'none'} now, but {recorded.path} was started with {began or 'none'}; give the same "
                "value to resume it"
            )


def has_results(recorded: "RunLog") -> bool:
    """True if the run has all its results, for the scans in its log."""
    return recorded.result() is not None and (recorded.path.parent / "report.html").is_file()  # written last


def is_finished(recorded: "RunLog", scans: "Dataset") -> bool:
    """True if the run has all its results, for all scans of the data set that can be read."""
    if not has_results(recorded):
        return False
    last = int(recorded.final()[1].scan_index[-1])  # scans are read only if the last one is missing
    return last == int(scans.scan_index[-1]) or last == int(scans.scan_index[first_usable(scans, backwards=True)[0]])


def check_preset(name: str, *, resumes: bool) -> None:
    """Raises SegslamError for an unknown preset, and for any preset if a run is resumed."""
    if name == "auto":
        return
    from segslam.scans.presets import SETTINGS

    if name not in SETTINGS:
        raise SegslamError(f"--preset {name}: unknown preset; known: auto, {', '.join(SETTINGS)}")
    if resumes:
        raise SegslamError(f"--preset {name}: a resumed run keeps its settings; omit the option")


def preset_config(name: str, scans: "Dataset", terminal: Terminal) -> "Config":
    """The settings of a preset; with `auto`, of the preset that fits the scans, with a message."""
    from segslam.scans.presets import extent_m, preset, preset_for

    if name == "auto":
        extent = extent_m(scans)
        name = preset_for(extent)
        show_preset(name, extent, terminal)
    return preset(cast("Preset", name))


def live_configs(name: str, output: Settings) -> "dict[Preset, Config]":
    """The settings for each preset that may fit the first scan: all the same unless `name` is `auto`."""
    check_preset(name, resumes=False)
    from segslam.scans.presets import SETTINGS, preset

    return {one: output.load(base=preset(one if name == "auto" else cast("Preset", name))) for one in SETTINGS}


def show_preset(chosen: "Preset", extent_m: float | None, terminal: Terminal) -> None:
    """Print the preset that fits the scans, unless it is the default."""
    if chosen != "driving":
        terminal.say(f"surfaces are near (median range {extent_m:.0f} m): using --preset {chosen}")
