"""The last scans of a drive in one cloud, registration of the next scan with it, and the likelihood of the result."""

from collections import deque
from collections.abc import Sequence
from functools import cached_property

import numpy as np

from segslam.core import geometry
from segslam.core.config import RefineConfig
from segslam.core.points import voxel_first, within_range
from segslam.core.types import Indices, Points, Registration, Transform
from segslam.odometry.likelihood import Correlation, Fit, fit
from segslam.odometry.nudge import NUM_POINTS, NUM_SEARCH, POLISH_VOXELS, SEARCH_VOXELS, nudge
from segslam.registration import refinement
from segslam.registration.free_space import FreeSpace
from segslam.registration.prepared import Observed

MAP_SCANS = 40
"""Chosen: number of scans in the map. With 10 the poses drift farther (NCLT 0.7 m, with 40 0.5 m, with 80 0.5 m)."""
NUM_WHOLE = 10
"""Number of the newest scans of which all points are kept, for registration without initial guess."""
SPACING_VOXELS = 0.4
"""Chosen: a scan nearer than this to the last one in the map (`geometry.displacement_m`) adds nothing to it."""
SEARCH_REFINE, SEARCH_VOXELS_GICP = 2.0, 1.4
"""Chosen: search distances of GICP: the first in those of `refine`, because how far a pose is off has nothing to do
with voxels, the last in voxels."""

MOST_CELLS = 1 << 20
"""Number of voxels from the start of the drive to where their keys are no longer distinct: 500 km."""


class SeenScan:
    """A scan: all its points, its downsampled points, and their surfaces, each computed on first use."""

    def __init__(self, points: Points, config: RefineConfig) -> None:
        """`points` (n, 3) in the scan's frame."""
        self.points = points
        self._config = config

    @property
    def _some(self) -> Points:
        """Some hundred of the points."""
        return self.points[:: max(1, len(self.points) // 500)]

    @cached_property
    def moments(self) -> geometry.Moments:
        """Of some hundred of the points, for `geometry.displacement_m`."""
        return geometry.moments_of(self._some.astype(np.float64))

    @cached_property
    def is_small(self) -> bool:
        """True if its downsampled points are too few to show its motion, as those of a wall just ahead of the sensor.

        Most scans need not be downsampled to know: some hundred of their points are in enough voxels.
        """
        few = len(voxel_first(self._some, self._config.voxel_m)) < refinement.MIN_POINTS
        return few and len(self.thinned) < refinement.MIN_POINTS

    @cached_property
    def thinned(self) -> Points:
        """(m, 3) the downsampled points."""
        return refinement.downsample(self.points, config=self._config)

    @cached_property
    def surface(self) -> refinement.Surface:
        """The surface, for GICP and the score."""
        return refinement.Surface(self.thinned, self._config)

    @cached_property
    def free_space(self) -> FreeSpace:
        """Where the sensor saw through."""
        return FreeSpace(self.points)

    @cached_property
    def observed(self) -> Observed:
        """For the score of loops."""
        return Observed(self.surface, self.free_space)


class LocalMap:
    """The last scans that moved, in the frame of the newest one."""

    def __init__(self, config: RefineConfig, correlation: Correlation) -> None:
        self.correlation = correlation
        self.voxel_m = config.voxel_m
        self.reach_m = SEARCH_REFINE * config.correspondence_m[0]
        """Distance that a registration reaches."""
        self.same_m = SEARCH_VOXELS_GICP * config.voxel_m
        """Poses at this distance are the same: a registration from one reaches the other."""
        self._config = config.model_copy(update={"correspondence_m": (self.reach_m, self.same_m)})
        self._scans: deque[tuple[Transform, Points]] = deque(maxlen=MAP_SCANS)
        self._whole: deque[tuple[Transform, SeenScan]] = deque(maxlen=NUM_WHOLE)
        self._voxels = Voxels(config.voxel_m)
        self._light: refinement.LightSurface | None = None
        self._surface: refinement.Surface | None = None
        self._roughness_m = 0.0

    @property
    def scans(self) -> list[tuple[Transform, Points]]:
        """T_odom_lidar and downsampled points (n, 3) of each scan, oldest first."""
        return list(self._scans)

    @property
    def T_odom_map(self) -> Transform:  # noqa: N802
        """Pose of the newest scan, whose frame is the map's."""
        return self._scans[-1][0]

    @property
    def newest(self) -> SeenScan:
        """The newest scan."""
        return self._whole[-1][1]

    def __len__(self) -> int:
        return len(self._scans)

    def pose_of(self, T_odom_lidar: Transform) -> Transform:
        """A pose of the odometry in the map's frame."""
        return geometry.inverse(self.T_odom_map) @ T_odom_lidar

    def add(self, T_odom_lidar: Transform, scan: SeenScan) -> None:
        """Add a scan, unless it is too near to the newest one."""
        if self._scans:
            moved_m = geometry.displacement_m(scan.moments, T_odom_lidar, self.T_odom_map)
            if moved_m < SPACING_VOXELS * self.voxel_m:
                return
        if len(self._scans) == MAP_SCANS:
            self._voxels.take_away(_moved(*self._scans[0]))
        self._scans.append((T_odom_lidar, scan.thinned))
        self._voxels.add(_moved(*self._scans[-1]))
        self._whole.append((T_odom_lidar, scan))
        self._light = self._surface = None

    def cloud(self, enough: int) -> Points:
        """All points of the newest scans, in the frame of the newest one: as many scans as give `enough` voxels."""
        gathered, num_thinned = [], 0
        for T_odom_lidar, scan in reversed(self._whole):
            is_newest = T_odom_lidar is self.T_odom_map  # coordinates on borders of voxels stay there
            gathered.append(scan.points if is_newest else _moved(self.pose_of(T_odom_lidar), scan.points))
            num_thinned += len(scan.thinned)
            if num_thinned >= enough:
                break
        return np.vstack(gathered).astype(np.float32)

    def light(self) -> refinement.LightSurface:
        """The surface of all scans as far from the newest one as a scan reaches, in its frame; cached."""
        if self._light is None:
            cloud = geometry.apply(geometry.inverse(self.T_odom_map), self._voxels.means())
            self._light = refinement.LightSurface(cloud[within_range(cloud, 0.0, refinement.MAX_RANGE_M)])
            self._roughness_m = self._light.roughness_m(self.voxel_m, NUM_POINTS)
        return self._light

    def surface(self) -> refinement.Surface:
        """The same, for GICP and the score; cached."""
        if self._surface is None:
            self._surface = refinement.Surface(self.light().points.astype(np.float32), self._config)
        return self._surface

    @property
    def observed(self) -> Observed:
        """The surface, with what the newest scan saw through."""
        return Observed(self.surface(), self.newest.free_space)

    def register(self, scan: SeenScan, T_map_guess: Transform) -> list[Fit]:
        """The pose of a scan in the map near an initial guess, by GICP and then robust steps; none without overlap."""
        found = refinement.refine(scan.surface, self.surface(), T_map_guess, config=self._config, must_converge=False)
        if not isinstance(found, Registration):
            return []
        polished = self._nudged(scan, found.T_target_source, POLISH_VOXELS, NUM_POINTS)
        return [] if polished is None else [polished]

    def approach(self, scan: SeenScan, T_map_guess: Transform, *, num_points: int = NUM_SEARCH) -> Fit | None:
        """The pose to which robust steps lead from a guess, with few points; None if too few are near the map."""
        return self._nudged(scan, T_map_guess, SEARCH_VOXELS, num_points)

    def fit(self, scan: SeenScan, T_map_lidar: Transform) -> Fit:
        """The likelihood of the scan at this pose."""
        surface = self.light()
        sigma_m = self._roughness_m
        return fit(scan.thinned, surface, T_map_lidar, self.correlation, voxel_m=self.voxel_m, sigma_m=sigma_m)

    def _nudged(self, scan: SeenScan, T_map_guess: Transform, reaches: Sequence[float], num_points: int) -> Fit | None:
        """None also if a step leads away from the map: along a single plane, which does not constrain it."""
        source, target = scan.thinned, self.light()
        found = nudge(source, target, T_map_guess, voxel_m=self.voxel_m, reaches=reaches, num_points=num_points)
        fit = None if found is None else self.fit(scan, found)
        return None if fit is None or fit.overlap == 0.0 else fit


class Voxels:
    """The mean point of each voxel of a fixed grid, of clouds that are added and taken away again."""

    def __init__(self, voxel_m: float) -> None:
        self._voxel_m = voxel_m
        self._keys = np.empty(0, np.int64)
        self._sums = np.empty((0, 4))
        """Of the points of each voxel, in order of the keys: coordinates and number."""

    def means(self) -> Points:
        """(m, 3) the mean points."""
        return self._sums[:, :3] / self._sums[:, 3:]

    def add(self, points: Points) -> None:
        """Add a cloud (n, 3)."""
        keys, sums = self._summed(points)
        rows = np.searchsorted(self._keys, keys)
        is_known = np.isin(keys, self._keys, assume_unique=True)
        self._sums[rows[is_known]] += sums[is_known]
        self._keys = np.insert(self._keys, rows[~is_known], keys[~is_known])
        self._sums = np.insert(self._sums, rows[~is_known], sums[~is_known], axis=0)

    def take_away(self, points: Points) -> None:
        """Take away a cloud that was added."""
        keys, sums = self._summed(points)
        self._sums[np.searchsorted(self._keys, keys)] -= sums
        left = self._sums[:, 3] > 0.0
        self._keys, self._sums = self._keys[left], self._sums[left]

    def _summed(self, points: Points) -> tuple[Indices, np.ndarray]:
        """Keys (k,) of the voxels of a cloud, ascending, and their sums (k, 4)."""
        # recorded coordinates are often multiples of a millimetre: a third of a voxel on, none is on a border
        cells = np.floor(points / self._voxel_m + 1.0 / 3.0).astype(np.int64) + MOST_CELLS
        keys, row = np.unique(cells @ np.array([(2 * MOST_CELLS) ** 2, 2 * MOST_CELLS, 1]), return_inverse=True)
        columns = [*points.T, np.ones(len(points))]
        return keys, np.column_stack([np.bincount(row, weights=column) for column in columns])


def _moved(T: Transform, points: Points) -> Points:
    return geometry.apply(T, points.astype(np.float64))
