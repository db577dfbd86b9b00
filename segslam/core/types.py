"""The records that travel between stages, and the array aliases of their fields.

Conventions. `T_a_b` is the pose of frame b in frame a: `p_a = T_a_b @ p_b`. Frames: world, odom, keyframe, lidar.
Tangents are [rotation rad; translation m] with the perturbation on the right, GTSAM's convention.
Stamps are integer nanoseconds. Labels are SemanticKITTI learning ids.
Shapes are checked under pytest only.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, fields
from enum import IntEnum, StrEnum
from functools import partial
from typing import Any, ClassVar, NoReturn

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numpy.typing import ArrayLike

from segslam.core.errors import BadScan as BadScan
from segslam.core.errors import SegslamError as SegslamError
from segslam.core.errors import WorkFailed as WorkFailed

Points = Float[np.ndarray, "_ 3"]
"""Points, a row each, in metres."""
Labels = UInt8[np.ndarray, "_"]
"""SemanticKITTI learning ids, one per point."""
CloudOf = Callable[[int], tuple[Points, Labels]]
"""Function from the id of a keyframe to its points, in its frame, and their labels."""
ScanLabels = Labels | Callable[[], Labels]
"""The labels of a scan, or a function that computes them, as for a network."""
Transform = Float[np.ndarray, "4 4"]
"""A rigid transform T_a_b."""
Rotation = Float[np.ndarray, "3 3"]
Tangent = Float[np.ndarray, "6"]
"""[rotation rad; translation m], right perturbation."""
Covariances = Float[np.ndarray, "_ 3 3"]
Direction = Float[np.ndarray, "3"]
Information = Float[np.ndarray, "6 6"]
"""Inverse covariance of a tangent, in the same order."""
Indices = Int[np.ndarray, "_"]
IndexPairs = Int[np.ndarray, "_ 2"]
Vector = Float[np.ndarray, "_"]
Mask = Bool[np.ndarray, "_"]


class Record:
    """Base of dataclasses with arrays; a representation of one line."""

    __slots__ = ()

    def __repr__(self) -> str:
        parts = (f"{field.name}={_short(getattr(self, field.name))}" for field in fields(self))  # type: ignore[arg-type]
        return f"{type(self).__name__}({', '.join(parts)})"


def _short(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return _pose(value) if value.shape == (4, 4) else f"<{value.dtype} {value.shape}>"
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, (tuple, list, dict)) and len(value) > 3:
        return f"<{len(value)} in a {type(value).__name__}>"
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key!r}: {_short(one)}" for key, one in value.items()) + "}"
    if isinstance(value, (tuple, list)):
        return f"({', '.join(_short(one) for one in value)})"
    return repr(value)


def _pose(T_a_b: np.ndarray) -> str:
    cosine = np.clip((np.trace(T_a_b[:3, :3]) - 1.0) / 2.0, -1.0, 1.0)
    x, y, z = T_a_b[:3, 3]
    return f"<{x:.2f} {y:.2f} {z:.2f} m, turned {np.degrees(np.arccos(cosine)):.1f} deg>"


def as_points(points: ArrayLike) -> Points:
    """The first three columns of an array-like object; float32 stays float32, all else becomes float64.

    Raises SegslamError for another shape, or if it holds no numbers.
    """
    try:
        array = np.asarray(points)
        array = array if array.dtype in (np.float32, np.float64) else array.astype(np.float64)
    except (TypeError, ValueError) as error:
        raise SegslamError(f"points: not an array of numbers ({error}); give rows of x, y, z") from error
    if array.ndim != 2 or array.shape[1] < 3:
        raise SegslamError(f"points: an array of shape {array.shape}; give rows of x, y, z, as of shape (n, 3)")
    return array[:, :3]


def as_labels(labels: ArrayLike | None, points: Points) -> Labels | None:
    """Learning ids as an array; None without labels. Raises SegslamError unless they are one `Label` for each point."""
    return None if labels is None else _ids(labels, len(points))


def _ids(labels: ArrayLike, num_points: int) -> Labels:
    try:
        array = np.asarray(labels)
        with np.errstate(invalid="ignore"):
            ids = array.astype(np.uint8, copy=False)
    except (TypeError, ValueError) as error:
        raise SegslamError(f"labels: not an array of numbers ({error}); give one for each point") from error
    if array.shape != (num_points,):
        raise SegslamError(f"labels: {array.size} labels for {num_points} points; give one for each")
    wrong = array[(array != ids) | (ids >= len(Label))]
    if len(wrong):
        raise SegslamError(f"labels: {wrong[0]} is not a learning id; give integers from 0 to {len(Label) - 1}")
    return ids


def _returned(function: Callable[[], ArrayLike], num_points: int) -> Labels:
    """The labels that a function returns, checked like others."""
    return _ids(function(), num_points)


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
    """Reason of a rejected registration or loop, in the order of the pipeline."""

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
    IMPROBABLE = "improbable"
    AMBIGUOUS = "ambiguous"
    NO_PLACE = "no_place"
    UNCONFIRMED = "unconfirmed"


@dataclass(frozen=True, slots=True, eq=False, repr=False, init=False)
class Scan(Record):
    """One sweep: points in the LiDAR frame (x ahead, y left, z up; m) and the stamp are enough.

    A network labels a scan when it becomes a keyframe; until then `labels` is a function without arguments that
    returns the labels.
    """

    points: Points
    stamp_ns: int
    index: int | None
    """Number of the scan in the drive; if None, `Slam` counts."""
    labels: ScanLabels
    """A row for each point, all UNLABELLED if unknown."""
    times: Vector
    """Per point, 0 at the sweep's start to 1 at its end; empty if unknown or already motion-compensated."""
    intensities: Vector | None
    """Per point, in the sensor's own unit; None if unknown or not requested."""
    kept: Mask | None
    """Rows of the file that the points were read from; None for all rows."""
    sweep_s: float
    """Duration from 0 to 1 of the times (s); 0 if unknown: the time between two scans."""
    stamp_time: float
    """When the sensor was at the pose of the scan, that is at its stamp, as a time like those of the points."""

    def __init__(
        self,
        points: ArrayLike,
        stamp_ns: int,
        index: int | None = None,
        labels: ScanLabels | ArrayLike | None = None,
        times: ArrayLike | None = None,
        intensities: ArrayLike | None = None,
        kept: Mask | None = None,
        sweep_s: float = 0.0,
        stamp_time: float = 1.0,
    ) -> None:
        """`points`: array-like with at least 3 columns; the first 3 are used. The others may be array-like, too.

        Raises SegslamError for another shape, for a stamp or number that is no integer, for labels, times or
        intensities that are not one for each point, for times that are not from 0 to 1, and for a negative duration.
        """
        xyz = as_points(points)
        if not isinstance(stamp_ns, int | np.integer):
            raise SegslamError(f"stamp_ns {stamp_ns!r}: give integer nanoseconds")
        if not isinstance(index, int | np.integer | None):
            raise SegslamError(f"index {index!r}: give an integer, or None")
        labels = partial(_returned, labels, len(xyz)) if callable(labels) else as_labels(labels, xyz)
        labels = np.zeros(len(xyz), np.uint8) if labels is None else labels
        times = np.empty(0) if times is None else np.asarray(times)
        if times.shape not in ((0,), (len(xyz),)):
            raise SegslamError(f"times: {times.size} times for {len(xyz)} points; give one for each, or none")
        if times.dtype.kind not in "biuf" or not ((times >= 0) & (times <= 1)).all():
            raise SegslamError("times: not all are numbers from 0, the start of the sweep, to 1, its end; or give none")
        if not 0.0 <= sweep_s < np.inf:
            raise SegslamError(f"sweep_s {sweep_s!r}: give the duration of a sweep in seconds, or 0 if it is unknown")
        if not 0.0 <= stamp_time <= 1.0:
            raise SegslamError(f"stamp_time {stamp_time!r}: give 0 for the start of the sweep, to 1 for its end")
        intensities = None if intensities is None else np.asarray(intensities)
        if intensities is not None and (intensities.shape != (len(xyz),) or intensities.dtype.kind not in "biuf"):
            raise SegslamError(f"intensities: {intensities.size} for {len(xyz)} points; give one number for each")
        values = (xyz, stamp_ns, index, labels, times, intensities, kept, sweep_s, stamp_time)
        for one, value in zip(fields(self), values, strict=True):
            object.__setattr__(self, one.name, value)


class MotionState(StrEnum):
    """Result of checking a motion against the scans."""

    UNCHECKED = "unchecked"
    """Not checked: the first scan, one of too few points, or a motion of other sensors that the scan does not show."""
    CONFIRMED = "confirmed"
    """The motion of other sensors, consistent with the scan."""
    REFINED = "refined"
    """Replaced by a registration, from which the motion of the odometry does not differ enough for a repair."""
    REPAIRED = "repaired"
    """Replaced by a registration, from which the odometry differed significantly; it starts again there."""
    REJOINED = "rejoined"
    """Registered with the scans before a break; only in logs of earlier versions."""
    BROKEN = "broken"
    """A break: the standard deviation of the motion is above a metre; its mean is the most likely one."""
    BEGUN = "begun"
    """First scan of another session of a merged run: its motion from the scan before is unknown."""


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Motion(Record):
    """The check of a scan's motion."""

    state: MotionState
    moved_m: float | None = None
    """Distance from the odometry's pose to the registered one; None if there was no registration."""
    moved_deg: float | None = None
    overlap: float | None = None
    """Share of the scan that lies on earlier scans, at the registered pose."""
    rms_m: float | None = None
    information: Information | None = None
    """Information of the motion in the graph; None if the noise model of the odometry holds."""
    covariance: Information | None = None
    """(6, 6) of the motion since the scan before, tangent in the scan's frame; None if it was not checked, or is
    that of other sensors."""

    @property
    def is_break(self) -> bool:
        """True if the motion is almost unknown."""
        return self.state in (MotionState.BEGUN, MotionState.BROKEN)


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Keyframe(Record):
    """A scan kept for loop closing. It has no world pose: the pose graph owns all world poses."""

    id: int
    scan_index: int
    stamp_ns: int
    T_odom_keyframe: Transform
    travel_m: float
    """Length of the odometry's path from the first scan."""
    points: Points
    """Motion-compensated, in the keyframe's frame, float32."""
    labels: Labels
    intensities: Vector | None = None
    """Intensities of the scan, per point; None if unknown."""
    labelled_by_shape: bool | None = None
    """True if the labels were computed from the points alone; None if unknown."""
    place: bytes | None = None
    """Signature by which its place is recognised (`segslam.candidates`); None where none was made."""


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Description(Record):
    """Features of one scan for matching, in the scan's frame: clusters (k rows) and key points (m rows).

    Each is a Gaussian with a class. Thousands of descriptions fit in memory.
    """

    means: Points = field(default_factory=partial(np.empty, (0, 3)))
    """Centres; for upright objects above observed ground, the point on the ground below."""
    covariances: Covariances = field(default_factory=partial(np.empty, (0, 3, 3)))
    """Normalised by the number of points (m^2)."""
    classes: Labels = field(default_factory=partial(np.empty, 0, np.uint8))
    sizes: Indices = field(default_factory=partial(np.empty, 0, np.int64))
    """Points in each cluster."""
    feature_points: Points = field(default_factory=partial(np.empty, (0, 3), np.float32))
    feature_covariances: Covariances = field(default_factory=partial(np.empty, (0, 3, 3), np.float32))
    """Of the patch around each key point."""
    feature_classes: Labels = field(default_factory=partial(np.empty, 0, np.uint8))
    feature_descriptors: Float[np.ndarray, "_ 33"] = field(default_factory=partial(np.empty, (0, 33), np.float16))
    """Square roots of FPFH at unit length."""
    ground_points: Points = field(default_factory=partial(np.empty, (0, 3), np.float32))
    """Centres of flat patches of the ground, a row each."""
    ground_normals: Points = field(default_factory=partial(np.empty, (0, 3), np.float32))
    """Unit normals of the patches, towards the sensor."""


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class LoopCandidate(Record):
    """A possible loop: the new keyframe `source_id` and the older `target_id`."""

    source_id: int
    target_id: int
    T_target_source_prior: Transform
    distance_m: float
    """Distance between the two positions, by the current estimate."""
    covariance: Information = field(default_factory=lambda: np.zeros((6, 6)))
    """Covariance of the prior, from the motions and loops between the two; zero if it is exact, or in older logs."""
    near_probability: float = 1.0
    """Probability that the two are so near each other, horizontally, that they see the same place."""

    @property
    def pair(self) -> tuple[int, int]:
        """Ids of the two keyframes, the newer first."""
        return self.source_id, self.target_id


class Found(Record):
    """Base of what is not `Rejected`."""

    __slots__ = ()
    ok: ClassVar[bool] = True
    """False for `Rejected`."""


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Registration(Found):
    """The pose of the source in the target: `p_target = T_target_source @ p_source`."""

    T_target_source: Transform
    num_correspondences: int
    num_inliers: int
    rms_m: float
    """Root mean square distance of the inliers."""
    information: Information
    num_edges: int = 0
    """Edges of the consistency graph (0 if the method has none)."""


@dataclass(frozen=True, slots=True)
class Rejected:
    """A failed registration or rejected loop. It has no pose, and no truth value: ask `isinstance`, or `ok`."""

    reason: RejectReason
    detail: str = ""
    probability: float | None = None
    """That the best pose is right; None if none could be judged."""
    evidence: dict[str, float] = field(default_factory=dict)
    """As that of `Alignment`."""
    ok: ClassVar[bool] = False
    """True for a registration, alignment or closure."""

    def __bool__(self) -> NoReturn:
        raise TypeError("a Rejected is neither true nor false; ask isinstance(found, Rejected), or found.ok")


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Alignment(Found):
    """A refined and verified registration."""

    coarse: Registration
    fine: Registration
    overlap: float
    """Share of the standing points within reach of the other scan that lie on it; the smaller of both directions."""
    rms_m: float
    """Root mean square distance of these points to the planes of the other scan (m)."""
    free_space_violation: float
    """Share of the points in space that the other scan observed empty."""
    observability: float = 1.0
    """Smallest divided by largest variance of the translation, 0 to 1: small along a corridor."""
    probability: float | None = None
    """That the pose is right; None in logs of older versions."""
    evidence: dict[str, float] = field(default_factory=dict)
    """Summands of its log odds by name (nats): `surfaces`, `free_space`, `usual` and `other_pose`."""

    @property
    def T_target_source(self) -> Transform:  # noqa: N802  (a transform)
        """The pose of the source in the target: `p_target = T_target_source @ p_source`, (4, 4)."""
        return self.fine.T_target_source


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class LoopClosure(Found):
    """A verified loop, a between-factor of the graph. `information`: of `T_target_source`, right perturbation."""

    source_id: int
    target_id: int
    T_target_source: Transform
    information: Information
    alignment: Alignment

    @classmethod
    def of(cls, source_id: int, target_id: int, alignment: Alignment) -> "LoopClosure":
        """The loop between two keyframes with the pose and information of their alignment."""
        return cls(source_id, target_id, alignment.fine.T_target_source, alignment.fine.information, alignment)

    @property
    def pair(self) -> tuple[int, int]:
        """Ids of the two keyframes, the newer first."""
        return self.source_id, self.target_id


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class LoopAttempt(Record):
    """A candidate and its outcome."""

    candidate: LoopCandidate
    outcome: LoopClosure | Rejected
    seconds: dict[str, float]
    """Seconds by stage (prepare, match, refine, verify); only stages that ran."""


def probability_text(probability: float, evidence: dict[str, float]) -> str:
    """In words: the probability that a pose is right, and the evidence that it is made of (nats)."""
    parts = ", ".join(f"{name.replace('_', ' ')} {value:+.1f}" for name, value in evidence.items())
    return f"probability {probability:.4f} ({parts})"


REJECTED_WEIGHT = 0.5
"""Closures with a smaller weight count as rejected by the optimiser."""


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Placement(Record):
    """The verified pose of a keyframe in an old map, one prior factor to be. `information` is that of the pose."""

    keyframe_id: int
    map_keyframe_id: int
    """The map's keyframe that it was registered with."""
    T_world_keyframe: Transform
    """In the map's world."""
    information: Information
    alignment: Alignment
    """With the map's keyframe."""
    is_found: bool
    """Found with no initial guess, or else tracked: registered from a predicted pose."""


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class GraphEstimate(Record):
    """The result of one optimisation."""

    T_world_keyframe: dict[int, Transform]
    error: float
    """Minimised cost as GTSAM defines it: half the chi-square, under robust kernels before the final optimisation."""
    closure_weights: dict[tuple[int, int], float]
    """(source_id, target_id) -> 0 (rejected) to 1 (full weight)."""
    motion_weights: dict[tuple[int, int], float] = field(default_factory=dict)
    """(keyframe_id, next keyframe_id) -> 0 for rejected motions of the odometry. All other motions have weight 1."""

    @property
    def rejected(self) -> set[tuple[int, int]]:
        """The closures (source_id, target_id) that the optimiser rejected."""
        return {pair for pair, weight in self.closure_weights.items() if weight < REJECTED_WEIGHT}


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Step(Record):
    """Everything that one scan caused."""

    scan_index: int
    stamp_ns: int
    T_odom_lidar: Transform
    keyframe: Keyframe | None
    attempts: tuple[LoopAttempt, ...]
    estimate: GraphEstimate | None
    """Present only if this step optimised the graph."""
    stage_seconds: dict[str, float]
    motion: Motion | None = None
    """Check of the scan's motion; None if it was not checked."""
    placements: tuple[Placement, ...] = ()
    """Keyframes placed in an old map: the keyframe of this step, and earlier ones that it confirms."""
    not_placed: Rejected | None = None
    """Why the keyframe of this step has no place in the old map; None if it has one, or there is no map."""


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class LateLoops(Record):
    """Loops tried after the last scan."""

    attempts: tuple[LoopAttempt, ...]


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Trajectory(Record):
    """Stamped poses, one row per scan. `T_world_lidar` (n, 4, 4); `scan_index`: numbers of the scans."""

    scan_index: Indices
    stamp_ns: Indices
    T_world_lidar: Float[np.ndarray, "_ 4 4"]

    def __len__(self) -> int:
        return len(self.scan_index)
