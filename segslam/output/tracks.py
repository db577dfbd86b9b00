"""Trajectories of georeferenced runs as GeoJSON, KML and GPX, and the origin of the map for Autoware."""

import json
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING
from xml.etree import ElementTree as Xml

import numpy as np

from segslam.core.types import Indices, SegslamError

if TYPE_CHECKING:
    from segslam.gnss import Origin
    from segslam.output.georeferenced import Globe

DEGREES, METRES = 9, 3
"""Decimals: 1e-9 degrees are 0.1 mm."""
KML, GPX = "http://www.opengis.net/kml/2.2", "http://www.topografix.com/GPX/1/1"
PROJECTOR_INFO = "map_projector_info.yaml"
"""Name of Autoware's file with the origin of a map."""
Rows = list[list[float]]
"""Longitude and latitude (degrees), height above the ellipsoid (m), of each scan."""


def is_track(file: Path) -> bool:
    """True for a file that this module writes."""
    return file.suffix.lower() in KINDS or file.name == PROJECTOR_INFO


def track(file: Path, globe: "Globe | None", stamp_ns: Indices, *, name: str) -> bytes:
    """The content of a file with the trajectory of a run, by the extension of its name.

    `stamp_ns` (n,): times of the scans, which GPX has if they are later than the year 2000; `name` of the track. Raises
    SegslamError if the run was not georeferenced.
    """
    if globe is None:
        raise SegslamError(f"{file}: the run has no place on the globe; `segslam georeference RUN --gnss FIXES` first")
    if file.name == PROJECTOR_INFO:
        return _projector_info(globe.origin)
    from segslam.gnss import geodetic_from_enu

    places = geodetic_from_enu(globe.T_enu_lidar[:, :3, 3], globe.origin)
    rows = [
        [round(longitude, DEGREES), round(latitude, DEGREES), round(height_m, METRES)]
        for latitude, longitude, height_m in places.tolist()
    ]
    return KINDS[file.suffix.lower()](rows, stamp_ns, name)


def _geojson(rows: Rows, stamp_ns: Indices, name: str) -> bytes:
    """RFC 7946: WGS84, longitude first. A track across the date line is cut into parts there (section 3.1.9)."""
    cuts = (np.flatnonzero(np.abs(np.diff([row[0] for row in rows])) > 180.0) + 1).tolist()
    parts = [rows[a:b] for a, b in zip([0, *cuts], [*cuts, len(rows)], strict=True)]
    parts = [part if len(part) > 1 else 2 * part for part in parts]
    line = {"type": "LineString", "coordinates": parts[0]}
    geometry = line if len(parts) == 1 else {"type": "MultiLineString", "coordinates": parts}
    feature = {"type": "Feature", "properties": {"name": name}, "geometry": geometry}
    return (json.dumps({"type": "FeatureCollection", "features": [feature]}) + "\n").encode()


def _kml(rows: Rows, stamp_ns: Indices, name: str) -> bytes:
    """OGC KML 2.2; heights are above the ellipsoid, so viewers draw the track on the ground."""
    root = Xml.Element("kml", xmlns=KML)
    placemark = Xml.SubElement(Xml.SubElement(root, "Document"), "Placemark")
    Xml.SubElement(placemark, "name").text = name
    line = Xml.SubElement(placemark, "LineString")
    Xml.SubElement(line, "altitudeMode").text = "clampToGround"
    Xml.SubElement(line, "coordinates").text = " ".join(",".join(map(str, row)) for row in rows)
    return _xml(root)


def _gpx(rows: Rows, stamp_ns: Indices, name: str) -> bytes:
    """GPX 1.1."""
    root = Xml.Element("gpx", xmlns=GPX, version="1.1", creator="segslam")
    made = Xml.SubElement(root, "trk")
    Xml.SubElement(made, "name").text = name
    segment = Xml.SubElement(made, "trkseg")
    since_2000 = datetime(2000, 1, 1, tzinfo=UTC).timestamp()
    for (longitude, latitude, height_m), stamp in zip(rows, stamp_ns, strict=True):
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


def _projector_info(origin: "Origin") -> bytes:
    """A local frame tangent to the ellipsoid, in which exported clouds other than LAS and LAZ are."""
    lines = (
        *("projector_type: LocalCartesian", "vertical_datum: WGS84", "map_origin:"),
        *(f"  latitude: {origin.latitude_deg:.10f}", f"  longitude: {origin.longitude_deg:.10f}"),
        f"  altitude: {origin.height_m:.4f}",
    )
    return "".join(line + "\n" for line in lines).encode()


KINDS: dict[str, Callable[[Rows, Indices, str], bytes]] = {".geojson": _geojson, ".kml": _kml, ".gpx": _gpx}
"""Writers by file extension."""
