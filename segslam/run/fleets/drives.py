"""The drives of a fleet: recordings with the options of `segslam map`, from a list in YAML or from paths."""

import hashlib
import json
import os
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

from segslam.core.config import parse_yaml, short
from segslam.core.errors import unreadable
from segslam.core.types import SegslamError
from segslam.core.whole_files import expanded, read_text
from segslam.labels.label_files import NETWORK, whole_source
from segslam.labels.network_settings import read_settings, settings_file


@dataclass(frozen=True, slots=True)
class Drive:
    """A recording, and how it is mapped: the options of `segslam map` under their names."""

    name: str
    data: str
    """Absolute path, the same on all machines."""
    dataset: str = ""
    sequence: str = "00"
    frames: str = ""
    topic: str = ""
    labels: str = "auto"
    encoding: str = ""
    odometry: str = ""
    preset: str = "auto"
    config: str = ""
    gnss: str = ""
    set: tuple[str, ...] = ()

    def key(self, version: str) -> str:
        """A hash of the recording, of the options, and of the version: equal keys stand for equal runs.

        Of a recording the names, sizes and times of its files are used, of a network also its settings and separate
        weights. Raises SegslamError if the recording is missing, or if the settings of the network are invalid.
        """
        options = {name: value for name, value in asdict(self).items() if name not in ("name", "data")}
        gnss = self.gnss if self.gnss and Path(self.gnss).exists() else ""  # otherwise a topic
        files = [path for path in (self.config, self.odometry, gnss) if path]
        data = Path(self.data)
        beside = [data.with_suffix(".json")] if data.suffix.lower() == ".pcap" else []  # metadata of the sensor
        if data.name == "velodyne":
            folder = "labels" if self.labels == "auto" else self.labels
            beside = [data.parent / name for name in (folder, "times.txt", "poses.txt")]
        if data.parent.name == "sequences":
            beside = [data.parent.parent / "poses" / f"{data.name}.txt"]  # true poses of KITTI's layout
        files += [str(file) for file in beside if file.exists()]
        labels = Path(self.labels.removeprefix(NETWORK))
        files += [str(labels)] if labels.is_absolute() and labels.exists() else []  # others are in the recording
        if self.labels.startswith(NETWORK) and labels.is_file():
            files += map(str, _separate_weights(labels))
        if self.labels.startswith(NETWORK) and (settings := settings_file(labels)).exists():
            options["network"] = read_settings(settings).model_dump(mode="json")
        return key_of(version, options, _state(data), *(_state(Path(file)) for file in files))


OPTIONS = tuple(field.name for field in fields(Drive))
PATHS = ("data", "odometry", "config", "gnss")


def key_of(*parts: Any) -> str:
    """A short hash of values that JSON can hold."""
    text = json.dumps(parts, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _state(path: Path) -> list[tuple[str, int, int]]:
    """Name, size and time of each file of a recording."""
    try:
        files = [path] if path.is_file() else sorted(_files_in(path))
        states = [(file, file.stat()) for file in files]
    except OSError as error:
        raise SegslamError(f"{unreadable(path, 'recording', error)}; correct the list of drives") from error
    return [(os.path.relpath(file, path), state.st_size, state.st_mtime_ns) for file, state in states]


def _separate_weights(model: Path) -> list[Path]:
    """The files with weights beside a network, which the `external_data` of its tensors name."""
    try:
        content = model.read_bytes()
    except OSError as error:
        raise SegslamError(f"{unreadable(model, 'network', error)}; correct its permissions") from error
    places = re.finditer(rb"\n\x08location\x12([\x01-\x7f])", content)
    names = sorted({content[place.end() : place.end() + place[1][0]] for place in places})
    return [file for name in names if (file := model.parent / os.fsdecode(name)).is_file()]


def _files_in(path: Path) -> Iterator[Path]:
    """The files within a folder; links to folders are followed, each folder once."""
    walked = {os.path.realpath(path)}
    for folder, within, names in os.walk(path, onerror=_raise, followlinks=True):
        real = {os.path.realpath(os.path.join(folder, name)): name for name in sorted(within)}
        within[:] = [name for target, name in real.items() if target not in walked]
        walked |= set(real)
        yield from (Path(folder) / name for name in names)


def _raise(error: OSError) -> None:
    raise error


def read_drives(file: Path) -> list[Drive]:
    """The drives of a list in YAML: paths, or mappings with the options of `segslam map`, `data` among them.

    Relative paths are relative to the list. Raises SegslamError, naming the file and the entry.
    """
    values = parse_yaml(read_text(file, "list of drives", "give a list of drives in YAML"), str(file))
    if isinstance(values, dict) and set(values) == {"drives"}:
        values = values["drives"]
    if not isinstance(values, list) or not values:
        raise SegslamError(f"{file}: expected a list of drives, found {short(values)}; write one line `- PATH` a drive")
    return _named([_drive(value, f"{file}: drive {number}", file.parent) for number, value in enumerate(values, 1)])


def drives_of(data: Sequence["Drive | str | Path"], *, config: Path | None = None) -> list[Drive]:
    """One drive for each recording, with the settings of a file; a Drive has its own, and is checked as in a list."""
    options = {"config": str(config)} if config else {}
    entries = [
        asdict(one) | {"data": str(one.data)} if isinstance(one, Drive) else {"data": str(one), **options}
        for one in data
    ]
    return _named([_drive(entry, entry["data"], Path.cwd()) for entry in entries])


def _drive(value: Any, where: str, folder: Path) -> Drive:
    """Raises SegslamError for an entry that is neither a path nor a mapping of known options."""
    given = {"data": value} if isinstance(value, str) else value
    if not isinstance(given, dict) or not given.get("data"):
        raise SegslamError(f"{where}: expected a path or options with data: PATH, found {short(value)}")
    unknown = [name for name in given if name not in OPTIONS]
    if unknown:
        raise SegslamError(f"{where}: unknown option {short(unknown[0])}; known: {', '.join(OPTIONS)}")
    given = {"name": "", **{name: one for name, one in given.items() if one is not None}}
    settings = given.pop("set", [])
    settings = [settings] if isinstance(settings, str) else settings
    if not isinstance(settings, list | tuple) or not all(isinstance(one, str) for one in settings):
        raise SegslamError(f"{where}: set: expected texts section.key=value, found {short(settings)}")
    texts = {name: _text(one, f"{where}: {name}") for name, one in given.items()}
    if texts.get("labels", "").startswith(NETWORK):
        texts["labels"] = whole_source(texts["labels"], folder)
    for name in PATHS:
        if texts.get(name):
            texts[name] = str((folder / expanded(texts[name])).resolve())
    if not re.fullmatch(r"[\w. +=@-]*", texts["name"]) or texts["name"].startswith("."):
        raise SegslamError(f"{where}: name {short(texts['name'])}: use letters, digits, spaces and _ . + = @ -")
    return Drive(**texts, set=tuple(settings))


def _text(value: Any, where: str) -> str:
    """Texts and numbers, such as a sequence without quotes."""
    if isinstance(value, bool) or not isinstance(value, str | int):
        raise SegslamError(f"{where}: expected a text, found {short(value)}; write it in quotes")
    return value if isinstance(value, str) else f"{value:02d}"


def _named(drives: list[Drive]) -> list[Drive]:
    """The drives with names: those given, or the names of their files, numbered where these are equal."""
    for drive, count in Counter(replace(drive, name="") for drive in drives).items():
        if count > 1:
            raise SegslamError(f"{drive.data}: given twice with the same options; give each drive once")
    given = [
        drive.name or re.sub(r"[^\w. +=@-]", "_", Path(drive.data).stem).lstrip(".") or "drive" for drive in drives
    ]
    counts, seen = Counter(given), Counter[str]()
    names = []
    for name in given:
        seen[name] += 1
        names.append(name if counts[name] == 1 else f"{name}-{seen[name]}")
    twice = [name for name, count in Counter(names).items() if count > 1]
    if twice:
        raise SegslamError(f"{twice[0]}: two drives have this name; give each its own")
    return [replace(drive, name=name) for drive, name in zip(drives, names, strict=True)]
