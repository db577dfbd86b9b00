"""`segslam map --dry-run`: content of the data and effective settings; writes nothing."""

from typing import TYPE_CHECKING, Any

from segslam.core.errors import BadScan, SegslamError, counted

if TYPE_CHECKING:
    from segslam.core.config import Config
    from segslam.core.types import Scan
    from segslam.scans import Dataset


def found_in(scans: "Dataset", settings: "Config") -> dict[str, Any]:
    """Figures of the data set and of its first readable scan. Raises SegslamError if no scan is readable."""
    import numpy as np

    from segslam.core import geometry
    from segslam.core.config import Config, changed_settings

    (first_row, first), (last_row, last) = first_usable(scans), first_usable(scans, backwards=True)
    seconds = (last.stamp_ns - first.stamp_ns) / 1e9
    ranges_m, elevations, _ = geometry.spherical(first.points)
    elevation_deg = np.degrees(elevations)
    return {
        "data": scans.name,
        "num_scans": len(scans),
        "first_scan": int(scans.scan_index[0]),
        "last_scan": int(scans.scan_index[-1]),
        "seconds": seconds,
        "vertical_angle_deg": scans.vertical_angle_deg,
        "scans_per_second": int(scans.scan_index[last_row] - scans.scan_index[first_row]) / seconds
        if seconds > 0
        else None,
        "labels": _labels(scans),
        "num_true_poses": 0 if scans.reference is None else len(scans.reference),
        "first_usable_scan": {
            "scan": int(scans.scan_index[first_row]),
            "num_points": len(first.points),
            "has_times": len(first.times) > 0,
            "sweep_s": first.sweep_s or None,
            "stamp_time": first.stamp_time if len(first.times) else None,
            "has_intensities": first.intensities is not None,
            "range_m": [float(ranges_m.min()), float(np.median(ranges_m)), float(ranges_m.max())],
            "elevation_deg": [float(value) for value in np.percentile(elevation_deg, (1, 99))],
        },
        "odometry": settings.odometry.model_dump(mode="json"),
        "changed_settings": {key: str(value) for key, _, value in changed_settings(Config(), settings)},
    }


def lines(found: dict[str, Any]) -> str:
    """The figures as text."""
    scan, odometry = found["first_usable_scan"], found["odometry"]
    rate = f", {found['scans_per_second']:.1f}/s" if found["scans_per_second"] else ""
    nearest, middle, farthest = scan["range_m"]
    low, high = scan["elevation_deg"]
    raised = f", {found['vertical_angle_deg']:+g} of correction" if found["vertical_angle_deg"] else ""
    truth = f"for {counted(found['num_true_poses'], 'scan')}" if found["num_true_poses"] else "none"
    changed = ", ".join(f"{key}={value}" for key, value in found["changed_settings"].items()) or "defaults"
    return "\n".join(
        [
            f"{found['data']}: {counted(found['num_scans'], 'scan')}, {found['first_scan']} to {found['last_scan']}, "
            f"over {found['seconds']:.1f} s{rate}",
            f"scan {scan['scan']}: {scan['num_points']} points at {nearest:.1f} to {farthest:.1f} m (median "
            f"{middle:.1f} m), elevations {low:.1f} to {high:.1f} degrees{raised}; "
            f"point times: {_times(scan)}; "
            f"intensities: {'read' if scan['has_intensities'] else 'not read'}",
            f"labels: {found['labels']}",
            f"ground-truth poses: {truth}",
            f"odometry: points between {odometry['min_range_m']} and {odometry['max_range_m']} m, "
            f"motion compensation {'on' if odometry['deskew'] else 'off'}",
            f"settings changed: {changed}",
            "nothing was written",
        ]
    )


def _times(scan: dict[str, Any]) -> str:
    """How the times of the points are understood."""
    if not scan["has_times"]:
        return "none, so the odometry does not compensate the motion within a sweep"
    if scan["sweep_s"] is None:
        return "a sweep from scan to scan"
    return f"a sweep of {scan['sweep_s']:.3f} s, poses at {scan['stamp_time'] * scan['sweep_s']:.3f} s of it"


def first_usable(scans: "Dataset", *, backwards: bool = False) -> "tuple[int, Scan]":
    """Row and scan of the first usable scan, or of the last with `backwards`."""
    why = ""
    for row in reversed(range(len(scans))) if backwards else range(len(scans)):
        try:
            return row, scans[row]
        except BadScan as error:
            why = why or str(error)
    raise SegslamError(f"{scans.name}: none of {counted(len(scans), 'scan')} can be used; the first: {why}")


def _labels(scans: "Dataset") -> str:
    source = scans.labels
    if source.network is not None:
        return "by network, for keyframes"
    if source.folder is not None:
        others = "geometric for the others" if source.geometric else "none for the others"
        return f"{source.folder} ({source.encoding} ids), {others}"
    return "geometric" if source.geometric else "none"
