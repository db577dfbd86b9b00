"""The last scans of a drive in one cloud, and registration of the next scan with it."""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from segslam import geometry, refinement
from segslam.config import HealthConfig, RefineConfig
from segslam.health.check import POLISH_M, RESIDUAL_SCALE_M, SEARCH_M, nudge
from segslam.types import Points, Registration, Transform

MIN_STANDING = 50
"""Chosen: with fewer points above the ground, all points are used."""
TURNS_RAD = np.radians(np.arange(-45.0, 46.0, 7.5))
TRAVELS = (0.0, 0.5, 1.0, 1.5)
"""Chosen: turns, and shares of the last step, of the poses that `around` compares; registration reaches half as far."""
NUM_COMPARED, COMPARED_M = 400, 0.5
"""Chosen: points that compare them, and the distance at which a point has half its weight."""


@dataclass(frozen=True, slots=True)
class Fit:
    """Fit of a scan to the local map: the quantities used for verification of loops, in one direction."""

    overlap: float
    """Share of the scan's points on steep surfaces that lie within `inlier_m` of the map, 0 to 1."""
    rms_m: float
    """Root mean square distance of these inliers to the planes of the map; `inlier_m` without inliers."""
    closeness: float = 0.0
    """Mean weight of these points by their distance to the planes, 0 to 1: greater if more points fit, and better."""
    is_map_new: bool = False
    """Whether the map has few scans, as after a break: sparse scans then overlap it much less than usual."""


class LocalMap:
    """The downsampled clouds of the last scans that moved, in the frame of the newest one."""

    def __init__(self, config: HealthConfig, refine: RefineConfig) -> None:
        self._config = config
        self._base = refine
        self._refine = refine.model_copy(update={"correspondence_m": config.correspondence_m})
        self._scans: deque[tuple[Transform, Points, Points]] = deque(maxlen=config.map_scans)
        """Pose, downsampled points and all points of each scan."""
        self._surface: refinement.Surface | None = None

    @property
    def scans(self) -> list[tuple[Transform, Points]]:
        """T_odom_lidar and downsampled points (n, 3) of each scan, oldest first."""
        return [(T_odom_lidar, thinned) for T_odom_lidar, thinned, _ in self._scans]

    @property
    def T_odom_map(self) -> Transform:  # noqa: N802
        """Pose of the newest scan, whose frame is the map's."""
        return self._scans[-1][0]

    def __len__(self) -> int:
        return len(self._scans)

    def empty_copy(self) -> "LocalMap":
        """An empty map with the same settings."""
        return LocalMap(self._config, self._base)

    def clear(self) -> None:
        """Remove all scans."""
        self._scans.clear()
        self._surface = None

    def add(self, T_odom_lidar: Transform, thinned: Points, points: Points) -> bool:
        """Add a scan, unless it is too near to the newest one; returns True if it was added."""
        if self._scans:
            T_map_lidar = geometry.inverse(self.T_odom_map) @ T_odom_lidar
            turned = geometry.angle(T_map_lidar) >= np.radians(self._config.map_spacing_deg)
            if geometry.distance(T_map_lidar) < self._config.map_spacing_m and not turned:
                return False
        self._scans.append((T_odom_lidar, thinned, points))
        self._surface = None
        return True

    def cloud(self, enough: int) -> Points:
        """All points of the newest scans, in the frame of the newest one: as many scans as give `enough` voxels."""
        T_map_odom = geometry.inverse(self.T_odom_map)
        gathered, num_thinned = [], 0
        for T_odom_lidar, thinned, points in reversed(self._scans):
            gathered.append(geometry.apply(T_map_odom @ T_odom_lidar, points.astype(np.float64)).astype(np.float32))
            num_thinned += len(thinned)
            if num_thinned >= enough:
                break
        return np.vstack(gathered)

    def downsample(self, points: Points) -> Points:
        """The points of a scan that the map stores, float32."""
        return refinement.downsample(points, config=self._refine)

    def make_surface(self, thinned: Points) -> refinement.Surface:
        """The surface of a downsampled scan, for `register` and `fit`."""
        return refinement.make_surface(thinned, config=self._refine)

    def surface(self) -> refinement.Surface:
        """The surface of all scans, in the frame of the newest one; cached."""
        if self._surface is None:
            T_map_odom = geometry.inverse(self.T_odom_map)
            clouds = [geometry.apply(T_map_odom @ T_odom_lidar, thinned) for T_odom_lidar, thinned, _ in self._scans]
            merged = clouds[0] if len(clouds) == 1 else refinement.merge_clouds(clouds, config=self._refine)
            self._surface = self.make_surface(merged)
        return self._surface

    def register(self, scan: refinement.Surface, T_map_guess: Transform) -> list[Transform]:
        """Poses of a scan in the map near an initial guess: by GICP, and by robust steps from the guess.

        GICP reaches farther. The robust steps end at the static scene where a vehicle ahead attracts GICP.
        """
        found = refinement.refine(scan, self.surface(), T_map_guess, config=self._refine, must_converge=False)
        starts: list[tuple[Transform, Sequence[float]]] = [(T_map_guess, SEARCH_M)]
        if isinstance(found, Registration):
            starts.append((found.T_target_source, POLISH_M))
        nudges = [nudge(scan.points, self.surface(), T_start, reaches_m=reaches_m) for T_start, reaches_m in starts]
        return [each.T_target_source for each in nudges if each is not None]

    def around(self, scan: refinement.Surface, T_map_last: Transform, T_step: Transform) -> Transform:
        """The best of some poses around the last one: turned to both sides, and moved by shares of the last step."""
        points = _standing(scan)
        points = points[:: max(1, len(points) // NUM_COMPARED)]
        tried = [
            T_map_last @ geometry.transform(geometry.yaw(turn), travel * T_step[:3, 3])
            for travel in TRAVELS
            for turn in TURNS_RAD.tolist()
        ]
        apart_m = [self.surface().nearest(geometry.apply(T_map_scan, points))[1] for T_map_scan in tried]
        return tried[int(np.argmax([np.mean(1.0 / (1.0 + (each / COMPARED_M) ** 2)) for each in apart_m]))]

    def fit(self, scan: refinement.Surface, T_map_lidar: Transform) -> Fit:
        """Fit of the scan to the map at this pose."""
        fit = _fit(scan, self.surface(), T_map_lidar, inlier_m=self._config.inlier_m)
        return replace(fit, is_map_new=len(self) < self._config.map_scans / 2)


def _fit(source: refinement.Surface, target: refinement.Surface, T_target_source: Transform, *, inlier_m: float) -> Fit:
    """Overlap and residual of the source's points on steep surfaces, or of all points if there are few."""
    chosen = _standing(source)
    if not len(chosen) or not len(target):
        return Fit(0.0, inlier_m)
    to_point, to_plane = target.distances_m(geometry.apply(T_target_source, chosen))
    met = to_plane[to_point < inlier_m]
    if not len(met):
        return Fit(0.0, inlier_m)
    weights = 1.0 / (1.0 + (met / RESIDUAL_SCALE_M) ** 2)
    return Fit(len(met) / len(chosen), float(np.sqrt(np.mean(met**2))), float(weights.sum()) / len(chosen))


def _standing(source: refinement.Surface) -> Points:
    """(k, 3) the points on steep surfaces, or all points if there are few."""
    standing = source.standing
    return standing if len(standing) >= MIN_STANDING else source.points
