"""The records that travel between stages, and the array aliases of their fields.

Conventions. `T_a_b` is the pose of frame b in frame a: `p_a = T_a_b @ p_b`. Frames: world, odom, keyframe, lidar.
Tangents are [rotation rad; translation m] with the perturbation on the right, GTSAM's convention.
Stamps are integer nanoseconds. Labels are SemanticKITTI learning ids.
Shapes are checked under pytest only.
"""

from dataclasses import dataclass, field
from enum import IntEnum, StrEnum

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from segslam.errors import BadScan as BadScan
from segslam.errors import SegslamError as SegslamError
from segslam.errors import WorkFailed as WorkFailed

Points = Float[np.ndarray, "_ 3"]
"""Points, a row each, in metres."""
Labels = UInt8[np.ndarray, "_"]
"""SemanticKITTI learning ids, one a point."""
Transform = Float[np.ndarray, "4 4"]
"""A rigid transform T_a_b."""
Rotation = Float[np.ndarray, "3 3"]
Tangent = Float[np.ndarray, "6"]
"""[rotation rad; translation m], right perturbation."""
Covariances = Float[np.ndarray, "_ 3 3"]
Information = Float[np.ndarray, "6 6"]
"""Inverse covariance of a tangent, in the same order."""
Indices = Int[np.ndarray, "_"]
IndexPairs = Int[np.ndarray, "_ 2"]
Vector = Float[np.ndarray, "_"]
Mask = Bool[np.ndarray, "_"]


class Label(IntEnum):
    """SemanticKITTI learning ids; the moving classes are those of its multi-scan task."""

    UNLABELLED = 0
    CAR = 1
    BICYCLE = 2
    MOTORCYCLE = 3
    TRUCK = 4
    OTHER_VEHICLE = 5
    PERSON = 6
    BICYCLIST = 7
    MOTORCYCLIST = 8
    ROAD = 9
    PARKING = 10
    SIDEWALK = 11
    OTHER_GROUND = 12
    BUILDING = 13
    FENCE = 14
    VEGETATION = 15
    TRUNK = 16
    TERRAIN = 17
    POLE = 18
    TRAFFIC_SIGN = 19
    MOVING_CAR = 20
    MOVING_BICYCLIST = 21
    MOVING_PERSON = 22
    MOVING_MOTORCYCLIST = 23
    MOVING_OTHER_VEHICLE = 24
    MOVING_TRUCK = 25


GROUND_LABELS = (Label.ROAD, Label.PARKING, Label.SIDEWALK, Label.OTHER_GROUND, Label.TERRAIN)


class RejectReason(StrEnum):
    """Why there is no registration or no loop, in the order of the pipeline."""

    TOO_FEW_POINTS = "too_few_points"
    TOO_FEW_CORRESPONDENCES = "too_few_correspondences"
    SMALL_CLIQUE = "small_clique"
    DEGENERATE = "degenerate"
    TOO_FEW_INLIERS = "too_few_inliers"
    FAR_FROM_PRIOR = "far_from_prior"
    REFINEMENT_DIVERGED = "refinement_diverged"
    LOW_OVERLAP = "low_overlap"
    HIGH_RESIDUAL = "high_residual"
    FREE_SPACE_VIOLATED = "free_space_violated"
    INCONSISTENT = "inconsistent"


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """One sweep. `points` (n, 3) in the LiDAR frame; `labels` (n,) has a row for each, all UNLABELLED if unknown."""

    index: int
    stamp_ns: int
    points: Points
    labels: Labels
    times: Vector = field(default_factory=lambda: np.empty(0))
    """Per point, 0 at the sweep's start to 1 at its end; empty if unknown or already motion-compensated."""
    intensities: Vector | None = None
    """Per point, in the sensor's own unit; None if unknown or not asked for."""


@dataclass(frozen=True, slots=True, eq=False)
class Keyframe:
    """A scan kept for loop closing. It has no world pose: the graph alone owns those."""

    id: int
    scan_index: int
    stamp_ns: int
    T_odom_keyframe: Transform
    travel_m: float
    """Length of the odometry's path from the first scan to here."""
    points: Points
    """Motion-compensated, in the keyframe's frame, float32."""
    labels: Labels
    intensities: Vector | None = None
    """Per point, as its scan has them; None if it has none."""


@dataclass(frozen=True, slots=True, eq=False)
class Description:
    """What matching needs of one scan, in the scan's frame: clusters (k rows) and point features (m rows).

    Each is a Gaussian with a class. Small enough to keep thousands of them.
    """

    means: Points
    """Centres; of upright things, where the ground is seen, the point of the ground beneath."""
    covariances: Covariances
    classes: Labels
    sizes: Indices
    """Points in each cluster."""
    feature_points: Points
    feature_covariances: Covariances
    feature_classes: Labels
    feature_descriptors: Float[np.ndarray, "_ 33"]
    """Square roots of FPFH at unit length, float16."""
    ground_points: Points = field(default_factory=lambda: np.empty((0, 3), np.float32))
    """Centres of flat patches of the ground, a row each."""
    ground_normals: Points = field(default_factory=lambda: np.empty((0, 3), np.float32))
    """Their unit normals, towards the side of the sensor."""


@dataclass(frozen=True, slots=True, eq=False)
class LoopCandidate:
    """A proposal: the new keyframe `source_id` may see what the old `target_id` saw. The prior only gates."""

    source_id: int
    target_id: int
    T_target_source_prior: Transform
    distance_m: float
    """Between the two positions, by the present estimate."""
    search_radius_m: float


@dataclass(frozen=True, slots=True, eq=False)
class Registration:
    """The pose of the source in the target: `p_target = T_target_source @ p_source`."""

    T_target_source: Transform
    num_correspondences: int
    num_inliers: int
    rms_m: float
    """Root mean square distance of the inliers."""
    information: Information
    num_edges: int = 0
    """Edges of the consistency graph (0 where the method has none)."""


@dataclass(frozen=True, slots=True)
class Rejected:
    """A registration that failed, or a loop that is none. There is no pose to misuse."""

    reason: RejectReason
    detail: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """A registration that was refined and verified; `fine.T_target_source` is the pose."""

    coarse: Registration
    fine: Registration
    overlap: float
    """Share of the standing points within reach of the other scan that lie on it; of the two ways, the smaller."""
    rms_m: float
    """Of those points, to the planes of the other surface."""
    free_space_violation: float
    """Share of the points that stand where the other scan saw empty space."""


@dataclass(frozen=True, slots=True, eq=False)
class LoopClosure:
    """A verified loop, one between-factor to be. `information` is that of `T_target_source`, right perturbation."""

    source_id: int
    target_id: int
    T_target_source: Transform
    information: Information
    alignment: Alignment


@dataclass(frozen=True, slots=True, eq=False)
class LoopAttempt:
    """A candidate and what came of it."""

    candidate: LoopCandidate
    outcome: LoopClosure | Rejected
    seconds: dict[str, float]
    """By stage: describe_source, describe_target, match, refine, verify; only those that ran."""


@dataclass(frozen=True, slots=True, eq=False)
class GraphEstimate:
    """What one optimisation gave."""

    T_world_keyframe: dict[int, Transform]
    error: float
    """GTSAM's: half the chi-square, robust kernels included."""
    closure_weights: dict[tuple[int, int], float]
    """(source_id, target_id) -> 0 (switched off) to 1 (fully trusted)."""


@dataclass(frozen=True, slots=True, eq=False)
class AngleSamples:
    """What pairs of scans along a drive tell of leftover angles, a row a pair. Columns: vertical, of azimuth."""

    travel_m: Vector
    """Of the middle between the two scans."""
    angle_rad: Float[np.ndarray, "n 2"]
    """By which all points lie too low; by which a point ahead lies too far left, and one behind too far right."""
    excess_rad_per_m: Float[np.ndarray, "n 2"]
    """How much too far down the odometry turned, and how much too far left."""


@dataclass(frozen=True, slots=True)
class DriftEvidence:
    """Whether leftover angles bent the odometry, and what speaks for it. None: too few scans to say."""

    chosen: bool
    reason: str
    num_pairs: int
    vertical_deg: float | None = None
    """Median over the drive; positive where points lie too low."""
    azimuth_deg: float | None = None
    """The same of azimuth; positive where a point ahead lies too far left."""
    vertical_change_deg: float | None = None
    """Sigma of the slow change around the mean."""
    azimuth_change_deg: float | None = None
    chi2_before: float | None = None
    """Of the odometry's excess turns in stretches held out of the fit, as they are."""
    chi2_after: float | None = None
    """The same, less what the angles around the stretches predict."""
    t_value: float | None = None
    """Of the agreement between prediction and excess, over stretches."""
    t_needed: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """All that one scan caused."""

    scan_index: int
    stamp_ns: int
    T_odom_lidar: Transform
    keyframe: Keyframe | None
    attempts: tuple[LoopAttempt, ...]
    estimate: GraphEstimate | None
    """Present only if this step optimised the graph."""
    stage_seconds: dict[str, float]


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """Stamped poses, a row a scan. `T_world_lidar` (n, 4, 4); `scan_index` says which scans they are."""

    scan_index: Indices
    stamp_ns: Indices
    T_world_lidar: Float[np.ndarray, "_ 4 4"]

    def __len__(self) -> int:
        return len(self.scan_index)
