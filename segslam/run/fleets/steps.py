"""The work of a fleet, each step a function of paths that any process with the same folder can call.

A step writes its result beside the final name and renames it when it is whole. What is there is not done again.
"""

import json
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from importlib.metadata import version
from pathlib import Path
from typing import Any, cast
from uuid import uuid4

import numpy as np

from segslam.candidates import Places, PlaceSignature
from segslam.core.config import Config, load_config
from segslam.core.types import SegslamError, Trajectory
from segslam.gnss.reading import read_fixes
from segslam.output.finished import read_metrics
from segslam.output.folder import UNFINISHED, log_of, write_poses
from segslam.output.georeferenced import georeference_if_possible
from segslam.output.log import read_log
from segslam.run.fleets.drives import Drive, key_of
from segslam.run.fleets.kept import Alignments, KeptAlignment, part_of, read_kept, unless_damaged, write_kept
from segslam.run.locator import Locator
from segslam.run.map_folder import given_odometry, map_folder, open_scans
from segslam.run.sessions.merge import arranged, write_merged
from segslam.run.sessions.recorded import Session, SessionPose, read_session
from segslam.run.sessions.session_pose import Relation, find_session
from segslam.scans import DataSource
from segslam.scans.presets import SETTINGS, Preset, extent_m, preset, preset_for

RUNS, INDEX, PROPOSALS, PAIRS, ALIGNMENTS = "runs", "index", "proposals", "pairs", "alignments"
KEY = "fleet.key"
"""File in a run folder of a fleet: the key that it was made with."""
MOST_LIKELY = 12
"""Chosen: largest number of keyframes that are searched in another drive, those that look most like a place there."""
NUM_SESSIONS = 4
"""Chosen: number of sessions in memory, some 10 MB for 5 km each: a drive is related to several others in turn."""
ONE_THREAD = "odometry.max_num_threads=1"
Likely = dict[str, list[tuple[int, float]]]
"""By the name of an earlier drive: keyframes of a drive and their largest similarities to a place there, best first."""


@dataclass(frozen=True, slots=True)
class Mapped:
    """A drive that is mapped."""

    name: str
    key: str

    def folder(self, fleet: Path) -> Path:
        """Its run."""
        return fleet / RUNS / self.name

    def signatures(self, fleet: Path) -> Path:
        """Signatures of its keyframes, (n, 24, 60)."""
        return fleet / INDEX / f"{self.name}-{self.key}.npy"


def _made_with(folder: Path) -> str:
    """The key that a whole folder was made with; empty if there is no folder.

    Raises SegslamError for a folder without a key: it is not of a fleet, and must not be replaced.
    """
    if not folder.exists():
        return ""
    try:
        return (folder / KEY).read_text(encoding="utf-8")
    except OSError as error:
        raise SegslamError(f"{folder}: not made by segslam fleet; give another folder with --out") from error


def map_drive(fleet: Path, drive: Drive) -> Mapped:
    """Map a drive into its run folder, as `segslam map` does. Raises SegslamError, as that does."""
    mapped = Mapped(drive.name, drive.key(version("segslam")))
    folder = mapped.folder(fleet)
    if _made_with(folder) == mapped.key:
        return mapped
    part = _beside(folder)
    names = ("sequence", "dataset", "labels", "encoding", "frames", "topic")
    options = {name: given for name in names if (given := getattr(drive, name))}
    source = DataSource(Path(drive.data), **options)
    config = _config(drive, source)
    fixes = read_fixes(drive.gnss, recording=source.data) if drive.gnss else None  # fails before the drive is mapped
    odometry = None
    if drive.odometry:
        odometry = given_odometry(Path(drive.odometry), open_scans(source, config), config.odometry)
    place = None if fixes is None else partial(georeference_if_possible, fixes=fixes, name=drive.name)
    map_folder(source.data, part, config=config, odometry=odometry, place=place, **options)
    _made(part, folder, mapped.key)
    return mapped


def _config(drive: Drive, source: DataSource) -> Config:
    """The settings of a drive: KISS-ICP has one thread, so that poses repeat exactly, unless they say otherwise."""
    if drive.preset != "auto" and drive.preset not in SETTINGS:
        raise SegslamError(f"preset: {drive.preset}: unknown preset; known: auto, {', '.join(SETTINGS)}")
    file = Path(drive.config) if drive.config else None
    scans = open_scans(source, load_config(file, drive.set))
    name = preset_for(extent_m(scans)) if drive.preset == "auto" else cast("Preset", drive.preset)
    return load_config(file, drive.set, base=load_config(None, [ONE_THREAD], base=preset(name)))


def index_drive(fleet: Path, drive: Mapped) -> Mapped:
    """Write the signatures of all keyframes of a run; returns the drive."""
    file = drive.signatures(fleet)
    if not file.exists():
        spectra = np.array([one.spectrum for one in _locator(_session(fleet, drive)).signatures])
        _replace(file, lambda part: np.save(part, spectra))
    return drive


def propose(fleet: Path, drive: Mapped, earlier: Sequence[Mapped]) -> Likely:
    """For each earlier drive, the keyframes of this one that look most like one of its places, by its name."""
    key = key_of([(one.name, one.key) for one in (*earlier, drive)])
    file = fleet / PROPOSALS / f"{drive.name}-{key}.json"
    if not file.exists():
        proposed = _proposed(fleet, drive, earlier)
        _replace(file, lambda part: part.write_text(json.dumps(proposed), encoding="utf-8"))
    with unless_damaged(file):
        found = json.loads(file.read_text(encoding="utf-8"))
        return {name: [(keyframe_id, score) for keyframe_id, score in likely] for name, likely in found.items()}


def _proposed(fleet: Path, drive: Mapped, earlier: Sequence[Mapped]) -> Likely:
    places, owners = Places(), list[str]()
    for other in earlier:
        for signature in _signatures(fleet, other):
            places.add(len(owners), signature)
            owners.append(other.name)
    likely: dict[str, dict[int, float]] = {}
    for keyframe_id, signature in enumerate(_signatures(fleet, drive)):
        for similar in places.shortlist(signature):
            likely.setdefault(owners[similar.place_id], {}).setdefault(keyframe_id, similar.score)  # best first
    return {
        name: sorted(scores.items(), key=lambda one: -one[1])[:MOST_LIKELY] for name, scores in sorted(likely.items())
    }


def _signatures(fleet: Path, drive: Mapped) -> Iterator[PlaceSignature]:
    """The signatures of all keyframes of a run. Raises SegslamError, naming the file, if it is damaged."""
    file = drive.signatures(fleet)
    with unless_damaged(file):
        spectra = np.load(file, mmap_mode="r")
    return (PlaceSignature(np.asarray(spectrum)) for spectrum in spectra)


def relate(fleet: Path, later: Mapped, earlier: Mapped, queries: Sequence[int]) -> Relation:
    """The pose of a drive in an earlier one, from its keyframes that look like places there."""
    file = fleet / PAIRS / f"{later.name} at {earlier.name}-{key_of(later.key, earlier.key, queries)}.json"
    if not file.exists():
        locator = _locator(_session(fleet, earlier))
        session = _session(fleet, later)  # the last one that is read: the next step needs it again
        relation = find_session(session, locator, config=locator.config, likely=queries)
        _replace(file, partial(write_kept, kind=Relation, value=relation))
    return read_kept(file, Relation)


def join(
    folder: Path, drives: Sequence[Mapped], poses: Sequence[SessionPose | None], same_reference: bool
) -> Mapping[str, Any]:
    """The drives of a component as one run in a folder of the fleet, by the pose of each in one before; its figures."""
    before, key = _made_with(folder), _component_key(drives, poses, same_reference)
    if before != key:
        part, fleet = _beside(folder), folder.parent
        sessions = [_session(fleet, drive) for drive in drives]
        if len(drives) == 1:
            shutil.copytree(drives[0].folder(fleet), part)
        else:
            part.mkdir()
            merged = arranged(sessions, poses, same_reference=same_reference)
            config = sessions[0].run.config
            parts = [
                part_of(drive.name, drive.key, one.T_world_keyframe, one.run.log.adjustment(), config=config.refine)
                for drive, one in zip(drives, sessions, strict=True)
            ]
            kept = Alignments(fleet / ALIGNMENTS, parts)
            # the component before is extended if it has two or more drives, the first of these
            is_extended = len(before.splitlines()) > 1 and key.startswith(before)
            log = read_log(folder) if is_extended else None
            write_merged(merged, part, config, kept=kept, before=log)
            for file, alignments in kept.changed():
                _replace(file, partial(write_kept, kind=tuple[KeptAlignment, ...], value=alignments))
        _write_drives(part / "drives", drives, sessions, read_log(part).final()[1])
        _made(part, folder, key)
    return read_metrics(folder)


def _component_key(drives: Sequence[Mapped], poses: Sequence[SessionPose | None], same_reference: bool) -> str:
    """A line for each drive, which depends on it and on those before: a component of the first has the first lines."""
    lines = [""]
    for drive, pose in zip(drives, poses, strict=True):
        related = pose and [pose.earlier, pose.T_earlier_world.tolist()]
        lines.append(key_of(lines[-1], drive.name, drive.key, related, same_reference))
    return "\n".join(lines[1:])


def _write_drives(folder: Path, drives: Sequence[Mapped], sessions: Sequence[Session], together: Trajectory) -> None:
    """The poses of each drive in the common frame, with its own scan numbers and stamps."""
    folder.mkdir()
    first = 0
    for drive, session in zip(drives, sessions, strict=True):
        own = session.run.result.trajectory
        rows = slice(first, first + len(own))
        poses = Trajectory(own.scan_index, own.stamp_ns, together.T_world_lidar[rows])
        write_poses(folder, drive.name, poses, session.run.T_camera_lidar)
        first = rows.stop


def _session(fleet: Path, drive: Mapped) -> Session:
    """The session of a drive, read once while step after step uses it; read again if its log was changed."""
    log = log_of(drive.folder(fleet))
    return _read(log, log.stat().st_mtime_ns if log.exists() else 0)


@lru_cache(NUM_SESSIONS)
def _read(log: Path, changed_ns: int) -> Session:
    return read_session(log)


_locator = lru_cache(2)(Locator)


def _beside(target: Path) -> Path:
    """A new name beside the target: two workers may do the same work, if the first seemed to be lost."""
    return target.with_name(f".{target.stem}.{uuid4().hex}{UNFINISHED}{target.suffix}")


def _made(part: Path, folder: Path, key: str) -> None:
    """A whole folder takes its final name, in place of one that was made with another key."""
    (part / KEY).write_text(key, encoding="utf-8")
    if _made_with(folder) == key:
        shutil.rmtree(part)
        return
    if folder.exists():
        old = _beside(folder)
        folder.rename(old)
        shutil.rmtree(old)
    part.rename(folder)


def _replace(file: Path, write: Any) -> None:
    """Write a file under another name, then rename it."""
    file.parent.mkdir(parents=True, exist_ok=True)
    part = _beside(file)
    write(part)
    part.replace(file)


def remove_components(fleet: Path, *, keep: int) -> None:
    """Remove the components of an earlier call beyond this number: drives that were alone are joined now."""
    while (folder := fleet / f"component_{keep}") and (folder / KEY).exists():
        shutil.rmtree(folder)
        keep += 1


def remove_unfinished(fleet: Path) -> None:
    """Remove what interrupted steps left (`_beside`)."""
    for folder in (fleet, *(fleet / name for name in (RUNS, INDEX, PROPOSALS, PAIRS, ALIGNMENTS))):
        for part in folder.glob(f".*.{'?' * 32}{UNFINISHED}*") if folder.is_dir() else ():
            shutil.rmtree(part) if part.is_dir() else part.unlink()
