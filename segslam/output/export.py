"""A finished run, written to files: its map, and its trajectory and origin on the globe (GeoJSON, KML, GPX, YAML)."""

import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import replace
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from time import perf_counter
from typing import Any
from xml.etree import ElementTree as Xml

import numpy as np

from segslam.core.config import MapConfig, load_config
from segslam.core.processes import Progress, no_progress
from segslam.core.types import Indices, Keyframe, SegslamError, Transform
from segslam.core.whole_files import all_expanded, cannot_write, expanded, whole_file
from segslam.gnss import Origin, geodetic_from_enu
from segslam.output.finished import read_corrections, read_result
from segslam.output.georeferenced import Globe, read_globe
from segslam.output.log import RunLog, read_log
from segslam.output.map.write import check_names, write_map
from segslam.output.report import BEFORE_AFTER, draw_before_after
from segslam.slam.slam_result import SlamResult

PROJECTOR_INFO = "map_projector_info.yaml"
"""Name of Autoware's file with the origin of a map."""
Rows = list[list[float]]
"""Longitude and latitude (degrees), height above the ellipsoid (m), of each scan."""


def export(
    run: str | Path, files: str | Path | Sequence[str | Path], *, settings: Sequence[str] = ()
) -> dict[str, Any]:
    """Write the map of a finished run, like `segslam export`; existing files are replaced. Returns figures of the map.

    `files`, one or several: .ply .pcd .las .laz (cloud), .png (top view), .yaml (grid) or before_after.png, and of a
    georeferenced run .tif, .geojson, .kml, .gpx and map_projector_info.yaml; all are written, or none.
    `settings`: changes such as `"map.color=height"`. Raises SegslamError, naming the file and the remedy.
    """
    log = read_log(expanded(run))
    config = load_config(None, settings, base=log.config).map
    return write_maps(log, all_expanded(files), config=config)


def write_maps(
    log: RunLog, files: Sequence[Path], *, config: MapConfig, show: Progress = no_progress
) -> dict[str, Any]:
    """Write the map of a finished run to each of the files, or to none. Returns figures of the map.

    `show` passes items on, and shows their number and a title.
    Raises SegslamError if the run did not finish or a name has an unknown extension, WorkFailed if the disk is full.
    """
    started = perf_counter()
    folder = log.path.parent
    globe = read_globe(folder)
    origin = None if globe is None else globe.origin
    if twice := [file for file in files if files.count(file) > 1]:
        raise SegslamError(f"{twice[0]}: given twice; give each file once")
    of_map = [file for file in files if file.name != BEFORE_AFTER and not is_track(file)]
    check_names(of_map, origin=origin, others=KINDS)
    result = read_result(log)
    with ExitStack() as complete:  # moves each file to its name at the end, after a failure none
        for file in files:
            if file.name == BEFORE_AFTER:
                complete.enter_context(whole_file(file)).write_bytes(draw_before_after(folder))
            elif is_track(file):
                rows = np.flatnonzero(result.localised())
                there = globe and replace(globe, T_enu_lidar=globe.T_enu_lidar[rows])
                cuts = (np.flatnonzero((np.diff(rows) > 1) | np.isin(rows[1:], result.begun)) + 1).tolist()
                content = track(file, there, result.trajectory.stamp_ns[rows], name=folder.resolve().name, cuts=cuts)
                complete.enter_context(whole_file(file)).write_bytes(content)
        if not of_map:
            return {"map_seconds": perf_counter() - started}
        try:
            begun = set(result.trajectory.scan_index[result.begun].tolist())
            placed = _placed(log, result, globe, show)
            made = write_map(placed, of_map, config=config, origin=origin, begun=begun, show=show)
        except OSError as error:
            raise cannot_write(of_map[0], error) from error
    return {**made, "map_seconds": perf_counter() - started}


def _placed(
    log: RunLog, result: SlamResult, globe: Globe | None, show: Progress
) -> Iterator[tuple[Keyframe, Transform]]:
    """Each keyframe of known pose, in the world or on the globe, its points corrected as in the adjustment."""
    num, num_read = len(result.estimate.T_world_keyframe), len(result.keyframe_rows)
    if num_read < num:
        readable = f"only {num_read} of its {num} keyframes are readable"
        raise SegslamError(f"{log.path}: damaged, {readable}; the map is not written. Map the data again, or replay it")
    corrections, localised = read_corrections(log, result), result.localised()
    for row, step in enumerate(show(log.steps(), log.num_steps(), "gather")):
        if step.keyframe is not None and localised[row]:
            number = step.keyframe.id
            points = corrections[number](step.keyframe.points)
            placed = result.estimate.T_world_keyframe[number] if globe is None else globe.T_enu_lidar[row]
            yield replace(step.keyframe, points=points), placed


def is_track(file: Path) -> bool:
    """True for a file that this module writes."""
    return file.suffix.lower() in KINDS or file.name == PROJECTOR_INFO


def track(file: Path, globe: Globe | None, stamp_ns: Indices, *, name: str, cuts: Sequence[int] = ()) -> bytes:
    """The content of a file with the trajectory of a run, by the extension of its name.

    `stamp_ns` (n,): times of the scans, which GPX has if they are later than the year 2000; `name` of the track; it has
    a gap before each of the scans `cuts`. Raises SegslamError if the run was not georeferenced.
    """
    if globe is None:
        raise SegslamError(f"{file}: the run has no place on the globe; `segslam georeference RUN --gnss FIXES` first")
    if file.name == PROJECTOR_INFO:
        return _projector_info(globe.origin)
    places = geodetic_from_enu(globe.T_enu_lidar[:, :3, 3], globe.origin)
    rows = [  # 1e-9 degrees are 0.1 mm
        [round(longitude, 9), round(latitude, 9), round(height_m, 3)]
        for latitude, longitude, height_m in places.tolist()
    ]
    return KINDS[file.suffix.lower()](rows, stamp_ns, name, cuts)


def _parts(rows: Rows, cuts: Iterable[int]) -> list[Rows]:
    """The parts between the cuts, of two rows at least: a line has two ends."""
    parts = [rows[a:b] for a, b in pairwise([0, *sorted(cuts), len(rows)])]
    return [part if len(part) > 1 else 2 * part for part in parts]


def _geojson(rows: Rows, stamp_ns: Indices, name: str, cuts: Sequence[int]) -> bytes:
    """RFC 7946: WGS84, longitude first. A track across the date line is cut into parts there (section 3.1.9)."""
    over = (np.flatnonzero(np.abs(np.diff([row[0] for row in rows])) > 180.0) + 1).tolist()
    parts = _parts(rows, {*cuts, *over})
    line = {"type": "LineString", "coordinates": parts[0]}
    geometry = line if len(parts) == 1 else {"type": "MultiLineString", "coordinates": parts}
    feature = {"type": "Feature", "properties": {"name": name}, "geometry": geometry}
    return (json.dumps({"type": "FeatureCollection", "features": [feature]}) + "\n").encode()


def _kml(rows: Rows, stamp_ns: Indices, name: str, cuts: Sequence[int]) -> bytes:
    """OGC KML 2.2; heights are above the ellipsoid, so viewers draw the track on the ground."""
    root = Xml.Element("kml", xmlns="http://www.opengis.net/kml/2.2")
    placemark = Xml.SubElement(Xml.SubElement(root, "Document"), "Placemark")
    Xml.SubElement(placemark, "name").text = name
    lines = Xml.SubElement(placemark, "MultiGeometry") if cuts else placemark
    for part in _parts(rows, cuts):
        line = Xml.SubElement(lines, "LineString")
        Xml.SubElement(line, "altitudeMode").text = "clampToGround"
        Xml.SubElement(line, "coordinates").text = " ".join(",".join(map(str, row)) for row in part)
    return _xml(root)


def _gpx(rows: Rows, stamp_ns: Indices, name: str, cuts: Sequence[int]) -> bytes:
    """GPX 1.1."""
    root = Xml.Element("gpx", xmlns="http://www.topografix.com/GPX/1/1", version="1.1", creator="segslam")
    made = Xml.SubElement(root, "trk")
    Xml.SubElement(made, "name").text = name
    segment = Xml.SubElement(made, "trkseg")
    since_2000 = datetime(2000, 1, 1, tzinfo=UTC).timestamp()
    for number, ((longitude, latitude, height_m), stamp) in enumerate(zip(rows, stamp_ns, strict=True)):
        if number in cuts:
            segment = Xml.SubElement(made, "trkseg")
        point = Xml.SubElement(segment, "trkpt", lat=str(latitude), lon=str(longitude))
        Xml.SubElement(point, "ele").text = str(height_m)
        if stamp > 1e9 * since_2000:
            time = datetime.fromtimestamp(1e-9 * int(stamp), tz=UTC).isoformat(timespec="milliseconds")
            Xml.SubElement(point, "time").text = time.replace("+00:00", "Z")
    return _xml(root)


def _xml(root: Xml.Element) -> bytes:
    Xml.indent(root)
    content: bytes = Xml.tostring(root, encoding="utf-8", xml_declaration=True)
    return content + b"\n"


def _projector_info(origin: Origin) -> bytes:
    """A local frame tangent to the ellipsoid, in which exported clouds other than LAS and LAZ are."""
    return (
        "projector_type: LocalCartesian\nvertical_datum: WGS84\nmap_origin:\n"
        f"  latitude: {origin.latitude_deg:.10f}\n  longitude: {origin.longitude_deg:.10f}\n"
        f"  altitude: {origin.height_m:.4f}\n"
    ).encode()


KINDS: dict[str, Callable[[Rows, Indices, str, Sequence[int]], bytes]] = {
    ".geojson": _geojson,
    ".kml": _kml,
    ".gpx": _gpx,
}
"""Writers by file extension."""
