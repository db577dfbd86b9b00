"""A run with its place on the globe: the files that `georeference` adds to a run folder, and their reader."""

import csv
import json
import logging
from collections.abc import Callable
from dataclasses import dataclass
from decimal import Decimal
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from segslam.core.pose_files import read_poses, write_tum
from segslam.core.trajectory import Poses, corrected_poses
from segslam.core.types import SegslamError
from segslam.core.whole_files import expanded, unless_damaged, whole_file, write_whole
from segslam.gnss import Drive, Fixes, Georeference, Origin, Use, geodetic_from_enu, utm_epsg
from segslam.gnss import georeference as georeference_drive
from segslam.gnss.fixes import DUPLICATE, NO_FIX, NOT_FINITE, OUTSIDE, Row
from segslam.gnss.geodesy import Geodetic
from segslam.gnss.reading import read_fixes
from segslam.graph.g2o import read_g2o
from segslam.output.finished import FinishedRun, read_run
from segslam.output.folder import ADJUSTED_GRAPH, PLACE_FILES, folder_of, log_of, room_for, write_csv, write_metrics
from segslam.output.log import schema
from segslam.output.log.locations import Locations, write_locations

logger = logging.getLogger(__name__)

FILE, FIXES, GEODETIC, ENU = PLACE_FILES
PLACE = ("datum", "latitude_deg", "longitude_deg", "height_m", "epsg", "T_enu_map", "sigma")
"""What a run localised in the map takes over from `FILE`."""
SIGMAS = ("east_m", "north_m", "up_m")
UNUSED = (NO_FIX, NOT_FINITE, DUPLICATE, OUTSIDE)
"""Reasons of fixes that a merged run does not use: those outside the drive may be at the time of another session."""
DEGREES_AND_HEIGHT = ("latitude_deg", "longitude_deg", "height_m")
not_damaged = partial(unless_damaged, remedy="run `segslam georeference` again")


@dataclass(frozen=True, slots=True, eq=False)
class Globe:
    """Where a finished run is on the globe."""

    origin: Origin
    T_enu_lidar: Poses
    """(n, 4, 4) poses of all scans in the local frame (east, north, up) at the origin."""


def georeference(
    run: str | Path, fixes: Fixes | str | Path, *, use: Use | str = Use.FUSE, offset_s: float = 0.0
) -> Georeference:
    """Place a finished run on the globe by its position fixes; the files are added to its folder.

    `use`: "align" places the map as it is, "fuse" also bends it where held-out fixes confirm that. `offset_s` is added
    to the times of the fixes. Raises SegslamError if the run or the fixes cannot be read, or if the fixes do not
    determine a placement.
    """
    if str(use) not in set(Use):
        raise SegslamError(f"georeference: use {use!r}: unknown; known: {', '.join(Use)}")
    if not np.isfinite(offset_s):
        raise SegslamError(f"georeference: offset_s={offset_s}; give a difference of clocks in seconds")
    finished = read_run(run)
    known = fixes if isinstance(fixes, Fixes) else read_fixes(fixes)
    scans = finished.result.trajectory
    breaks = [row for row, motion in enumerate(finished.result.motions) if motion.is_break]
    drive = Drive(scans.stamp_ns, scans.T_world_lidar, finished.result.keyframe_rows, breaks)
    if in_map := finished.options.get("in_map"):
        raise SegslamError(
            f"{finished.folder}: localised in the map of {in_map}; georeference that run, and localise the data again"
        )
    graph = finished.folder / ADJUSTED_GRAPH
    if not graph.exists():
        raise SegslamError(
            f"{graph}: missing, the run was made by an earlier version; `segslam replay` it into a new folder first"
        )
    placed = georeference_drive(read_g2o(graph).edges, drive, known, use=Use(use), offset_s=offset_s)
    T_enu_lidar = corrected_poses(
        drive.T_map_lidar,
        drive.keyframe_rows,
        placed.T_enu_keyframe,
        after_break=np.isin(drive.keyframe_rows, breaks),
    )
    _write(finished, placed, T_enu_lidar, Use(use), offset_s)
    return placed


def read_globe(folder: Path) -> Globe | None:
    """The place of a run on the globe; None if it was not georeferenced. Raises SegslamError for damaged files."""
    file = folder / FILE
    if not file.exists():
        return None
    with not_damaged(file):
        values = json.loads(file.read_text(encoding="utf-8"))
        origin = Origin(*(float(values[name]) for name in DEGREES_AND_HEIGHT))
    return Globe(origin, read_poses(folder / ENU, format="tum").T_a_b)


def georeference_if_possible(
    folder: Path, fixes: Fixes | Callable[[], Fixes], *, name: str = "", use: str = Use.FUSE, offset_s: float = 0.0
) -> str:
    """As `georeference` of a run with another `name` in messages; returns what was found. Failures are warnings."""
    try:
        return summary(georeference(folder, fixes() if callable(fixes) else fixes, use=use, offset_s=offset_s))
    except SegslamError as error:
        logger.warning("%s: has no place on the globe: %s", name or folder, error)
        return ""


def take_over(run: str | Path, map_run: str | Path) -> str:
    """Place a run that was localised in the map of a georeferenced run on the globe; returns what was done.

    Empty if that has no place, or no scan was localised.

    Each scan keeps its pose relative to the nearest keyframe of the map, so that it moves as the map was bent.
    """
    source = folder_of(expanded(map_run))
    globe = read_globe(source)
    if globe is None:
        return ""
    made, mapped = read_run(run), read_run(source).result
    if not made.result.localised().any():
        return ""
    T_world_keyframe = mapped.trajectory.T_world_lidar[mapped.keyframe_rows]
    T_enu_map = globe.T_enu_lidar[mapped.keyframe_rows] @ np.linalg.inv(T_world_keyframe)
    poses = made.result.trajectory.T_world_lidar
    _, nearest = cKDTree(T_world_keyframe[:, :3, 3]).query(poses[:, :3, 3])
    of_map = json.loads((source / FILE).read_text(encoding="utf-8"))
    values = {name: of_map[name] for name in PLACE if name in of_map} | {"in_map": str(source.resolve())}
    with room_for(made.folder):
        places = _write_poses(made, globe.origin, T_enu_map[nearest] @ poses)
        is_localised = made.result.localised()
        stamp_ns = made.result.trajectory.stamp_ns[is_localised]
        sigma_m = np.array([values.get("sigma", {}).get(name) or np.nan for name in SIGMAS])
        shown = Locations(schema.LIDAR, stamp_ns, places[is_localised], sigma_m)
        write_locations(log_of(made.folder), {schema.POSITIONS: shown})
        write_whole(made.folder / FILE, json.dumps(values, indent=2) + "\n")
    return f"place on the globe: that of the map, see {GEODETIC}"


def recorded_fixes(folder: Path, *, stamp_shift_ns: int = 0) -> tuple[list[Row], str]:
    """The fixes of a run, in the clock of its scans, shifted, and how they were used; without fixes, both are empty.

    Without `UNUSED` ones. Raises SegslamError for damaged files.
    """
    file = folder / FIXES
    if not file.exists():
        return [], ""
    with not_damaged(file):
        values = json.loads((folder / FILE).read_text(encoding="utf-8"))
        offset_ns = round(1e9 * (values["given_offset_s"] + values["clock_offset_s"])) + stamp_shift_ns
        with file.open(newline="", encoding="utf-8") as stream:
            rows = [row for row in csv.DictReader(stream) if row["reason"] not in UNUSED]
        found = []
        for row in rows:
            latitude, longitude, height_m = (float(row[name] or "nan") for name in DEGREES_AND_HEIGHT)
            found.append(Row(int(row["stamp_ns"]) + offset_ns, latitude, longitude, height_m))
        return found, str(values.get("use", ""))


def _write(run: FinishedRun, placed: Georeference, T_enu_lidar: Poses, use: Use, offset_s: float) -> None:
    trajectory, fixes = run.result.trajectory, placed.fixes
    within = np.isfinite(placed.residual_m[:, 0])  # the drive
    measured_ns = fixes.stamp_ns[within] + round(1e9 * (offset_s + placed.measured_offset_s))
    with room_for(run.folder):
        places = _write_poses(run, placed.origin, T_enu_lidar)
        shown = {
            schema.FIXES: Locations(schema.ANTENNA, measured_ns, fixes.places[within], placed.fix_sigma_m),
            schema.POSITIONS: Locations(schema.LIDAR, trajectory.stamp_ns, places, placed.position_sigma_m),
        }
        write_locations(log_of(run.folder), shown)
        _write_fixes(run.folder, placed)
        values = figures(placed) | {"use": str(use), "given_offset_s": offset_s}
        write_whole(run.folder / FILE, json.dumps(values, indent=2) + "\n")
        num_kept = placed.num_kept
        write_metrics(run.folder, run.metrics | {"gnss_kept": num_kept, "gnss_dropped": len(fixes) - num_kept})


def _write_poses(run: FinishedRun, origin: Origin, T_enu_lidar: Poses) -> Geodetic:
    """The two files with poses; returns the geodetic positions of all scans.

    `GEODETIC` has a row for each localised scan, with the heading of its x axis clockwise from north.
    """
    trajectory = run.result.trajectory
    (run.folder / FILE).unlink(missing_ok=True)  # of another origin; it is written last
    places = geodetic_from_enu(T_enu_lidar[:, :3, 3], origin)
    with whole_file(run.folder / ENU) as part:
        write_tum(part, trajectory.stamp_ns, T_enu_lidar)
    heading_deg = np.degrees(np.arctan2(T_enu_lidar[:, 0, 0], T_enu_lidar[:, 1, 0])) % 360.0
    localised = (values[run.result.localised()] for values in (trajectory.stamp_ns, places, heading_deg))
    rows = (
        (f"{Decimal(int(ns)).scaleb(-9):f}", f"{latitude:.10f}", f"{longitude:.10f}", f"{height:.4f}", f"{heading:.4f}")
        for ns, (latitude, longitude, height), heading in zip(*localised, strict=True)
    )
    write_csv(run.folder / GEODETIC, ("seconds", "latitude", "longitude", "height", "heading"), rows)
    return places


def figures(placed: Georeference) -> dict[str, Any]:
    """The content of `georeference.json`; unknown figures are null."""
    origin = placed.origin
    return {
        "datum": "WGS84 (EPSG:4979)",
        **origin._asdict(),
        "epsg": utm_epsg(origin.latitude_deg, origin.longitude_deg),
        "T_enu_map": placed.T_enu_map.ravel().tolist(),
        "sigma": dict(zip(SIGMAS, _known(placed.position_sigma_m), strict=True))
        | {"heading_deg": placed.heading_sigma_deg},
        "fix_sigma_m": _known(placed.fix_sigma_m),
        "num_fixes": len(placed.fixes),
        "num_fixes_kept": placed.num_kept,
        "is_bent_horizontally": placed.is_bent[0],
        "is_bent_in_height": placed.is_bent[1],
        "clock_offset_s": placed.measured_offset_s,
        "clock_offset_sigma_s": placed.offset_sigma_s or None,
        "lever_arm_m": _known(placed.arm_m),
        "lever_arm_sigma_m": [sigma_m or None for sigma_m in _known(placed.arm_sigma_m)],
        "source": Path(placed.fixes.source).name,
        "note": placed.fixes.note,
    }


def _known(values: np.ndarray) -> list[float | None]:
    return [float(value) if np.isfinite(value) else None for value in values]


def _write_fixes(folder: Path, placed: Georeference) -> None:
    """A row a fix: what was measured, by how much it differs from the drive, and whether it was kept or why not."""
    known = (*DEGREES_AND_HEIGHT, *SIGMAS, *(f"residual_{name}" for name in SIGMAS), "weight", "weight_up")
    values = np.column_stack([placed.fixes.places, placed.measured_enu_m, placed.residual_m, placed.weights])
    digits = [10, 10, *[4] * (len(known) - 2)]  # of degrees, and of all others
    rows = (
        (
            int(stamp_ns),
            *(f"{value:.{num}f}" if np.isfinite(value) else "" for value, num in zip(row, digits, strict=True)),
            *(int(not reason), reason),
        )
        for stamp_ns, row, reason in zip(placed.fixes.stamp_ns, values, placed.reasons, strict=True)
    )
    write_csv(folder / FIXES, ("stamp_ns", *known, "kept", "reason"), rows)


def summary(placed: Georeference) -> str:
    """What the fixes say, and what they were used for."""
    east, north, _ = placed.position_sigma_m
    lines = [
        f"{placed.num_kept} of {len(placed.fixes)} fixes kept; single fixes are off by {placed.fix_sigma_m[0]:.2f} m, "
        "a standard deviation",
        f"map placed: heading known to {placed.heading_sigma_deg:.2f} degrees, position to {east:.2f} m east and "
        f"{north:.2f} m north",
    ]
    axes = [name for name, is_bent in zip(("horizontally", "in height"), placed.is_bent, strict=True) if is_bent]
    lines.append(f"trajectory bent {' and '.join(axes)} by the fixes" if axes else "trajectory kept its shape")
    if placed.measured_offset_s:
        lines.append(
            f"clock of the receiver: {placed.measured_offset_s:+.3f} s added to its times, "
            f"known to {placed.offset_sigma_s:.3f} s"
        )
    if placed.arm_m.any():
        lines.append(
            f"antenna {placed.arm_m[0]:+.2f} m ahead and {placed.arm_m[1]:+.2f} m to the left of the LiDAR, "
            f"known to {max(placed.arm_sigma_m):.2f} m"
        )
    if placed.fixes.note:
        lines.append(placed.fixes.note)
    return "\n".join(lines)
