"""Every parameter, with unit, range and, in square brackets, the source of its default. Unknown keys are refused.

Most users need `USER_SETTINGS` only. Sources: the Segregator paper (Yin et al., ICRA 2023), its authors' program, the
library that uses the value, measured (on what), or chosen (on what, where data decided).
"""

from typing import Annotated, Literal

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, PlainSerializer, model_validator

from segslam.core.types import Label

USER_SETTINGS = (
    "sensor.vertical_angle_deg",
    "odometry.max_range_m",
    "odometry.min_range_m",
    "odometry.voxel_size_m",
    "odometry.deskew",
    "health.check",
    "keyframes.distance_m",
    "keyframes.voxel_m",
    "proximity.min_travel_m",
    "proximity.base_radius_m",
    "verify.max_false_share",
    "graph.final",
    "graph.error_allowance",
    "map.voxel_m",
    "map.color",
)
"""The settings for most users, the first ones of their sections. All others are for experts."""


def _label_from_name(value: object) -> object:
    if not isinstance(value, str):
        return value
    name = value.upper().replace("-", "_")
    if name not in Label.__members__:
        raise ValueError(f"no such class; known: {', '.join(label.name.lower() for label in Label)}")
    return Label[name]


LabelName = Annotated[Label, BeforeValidator(_label_from_name), PlainSerializer(lambda label: label.name.lower())]
"""A class by its name in files, such as `traffic_sign`."""


def _check_static(label: Label) -> Label:
    if label == Label.UNLABELLED or label >= Label.MOVING_CAR:
        raise ValueError("only static classes can be used to recognise a place")
    return label


StaticLabel = Annotated[LabelName, AfterValidator(_check_static)]
Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]


class Section(BaseModel):
    """Base of all sections: immutable; unknown keys, infinities and NaN are refused. Docstrings describe the fields."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", validate_default=True, allow_inf_nan=False, use_attribute_docstrings=True
    )


class SensorCalibrationConfig(Section):
    """Calibration of the LiDAR, applied when its scans are read."""

    vertical_angle_deg: float | None = Field(None, ge=-5, le=5)
    """elevation added to all points of a scan; positive if the sensor measures points too low; `null`: 0.205 for data
    in KITTI's layout, 0 for all other data (degrees) [KISS-ICP, for KITTI]"""


class OdometryConfig(Section):
    """Parameters of KISS-ICP, under its own names."""

    max_range_m: Positive = 100.0
    """points farther away are dropped (m) [KISS-ICP]"""
    min_range_m: NotNegative = 3.0
    """points nearer than this are dropped: returns from the vehicle itself (m) [chosen for KITTI's car]"""
    voxel_size_m: Positive = 1.0
    """voxel size of KISS-ICP's local map (m) [KISS-ICP]"""
    deskew: bool = True
    """compensate the motion within a sweep, if the points have times [KISS-ICP]"""
    max_num_threads: int = Field(0, ge=0)
    """threads of KISS-ICP; 0: all cores, in any order: poses are rounded, so that they repeat [KISS-ICP]"""

    @model_validator(mode="after")
    def _has_a_range(self) -> "OdometryConfig":
        if self.max_range_m <= self.min_range_m:
            raise ValueError(f"max_range_m {self.max_range_m:g} must be above min_range_m {self.min_range_m:g}")
        return self


class HealthConfig(Section):
    """Comparison of the odometry's motions with the scans."""

    check: bool = True
    """compare the motions of the odometry with the scans, and keep more likely ones [chosen]"""


class KeyframeConfig(Section):
    """Selection of keyframes, and their resolution."""

    distance_m: Positive = 2.0
    """distance between keyframes (m) [chosen]"""
    voxel_m: Positive = 0.2
    """voxel size to which keyframes are downsampled, except for the classes that form clusters (m) [chosen]"""
    resolution_m: Positive = 0.004
    """grid to which the coordinates of keyframes are rounded (m) [chosen]"""


class ProximityConfig(Section):
    """Search for loop candidates near the estimated position."""

    min_travel_m: NotNegative = 50.0
    """smallest distance travelled between the two keyframes of a loop (m) [chosen]"""
    base_radius_m: Positive = 6.0
    """keyframes at most so far apart see the same place; drift is added to it (m) [chosen on simulated drives]"""


class RetrievalConfig(Section):
    """Loop closing by place recognition, independent of drift."""

    enabled: bool = True
    """search loops also where the poses do not show which keyframes are near, by similarity of places [chosen]"""


class SegregatorConfig(Section):
    """Global registration from semantic clusters and point features."""

    cluster_min_points: dict[StaticLabel, Annotated[int, Field(ge=1)]] = {
        Label.CAR: 6,
        Label.TRUCK: 6,
        Label.OTHER_VEHICLE: 6,
        Label.TRUNK: 4,
        Label.POLE: 4,
        Label.TRAFFIC_SIGN: 3,
    }
    """classes that form clusters, and the smallest number of points of a cluster [paper: L_SC; authors: car 30, trunk
    15; chosen]"""
    max_clusters_per_class: int = Field(24, ge=3)
    """largest number of clusters per class; those with the largest visible surface are kept [chosen]"""
    foot_classes: tuple[StaticLabel, ...] = (Label.TRUNK, Label.POLE, Label.TRAFFIC_SIGN)
    """classes of upright objects: the position of their clusters is the foot on the ground [chosen]"""
    dcvc_pitch_deg: float = Field(2.0, ge=0.1, le=90)
    """pitch bin of DCVC, at least the spacing of the beams (degrees) [authors: 1.2; chosen]"""
    feature_voxel_m: float = Field(0.35, ge=0.01)
    """voxel size of the class clouds (m) [authors: 0.5; chosen]"""
    normal_radius_m: Positive = 0.7
    """radius of the patch from which the normal and the Gaussian of a point are computed (m) [authors: 1.0; chosen]"""
    feature_radius_m: Positive = 2.0
    """neighbourhood of FPFH (m) [authors: 2.5; chosen]"""
    max_features_per_class: int = Field(750, ge=1)
    """largest number of key points per class; those with most neighbours are kept; 1,500 take 175 kB [chosen]"""
    features: Literal["always", "when_few_clusters", "never"] = "when_few_clusters"
    """when FPFH key points are computed for a scan [chosen]"""
    gate: Literal["published", "invariant", "lengths"] = "invariant"
    """G-TRIM: published; invariant: with eigenvalues, invariant under rotation; lengths: lengths only [paper; chosen;
    Segator]"""
    noise_bounds_m: tuple[Positive, ...] = Field((0.2, 0.4), min_length=1)
    """noise bounds of a position, tried in order until the pose is certain; two lengths may differ by twice the bound
    (m) [paper and authors: 0.2; chosen: 0.4]"""
    shape_bound_m2: Positive = 0.3
    """G-TRIM: largest squared Wasserstein distance between two shapes (m^2) [chosen]"""
    min_clique: int = Field(3, ge=3)
    """size of the smallest clique of inliers that is accepted [chosen on simulated 00 and 08]"""
    max_cliques: int = Field(8, ge=1)
    """largest number of maximum cliques tried at each bound [chosen]"""
    solver: Literal["gaussians", "joint", "decoupled"] = "gaussians"
    """joint: rotation and translation together; decoupled: one after the other; gaussians: joint, then refined by
    aligning clusters and ground, weighted by their covariances [authors: decoupled; chosen]"""
    rotation: Literal["full", "yaw"] = "full"
    """degrees of freedom of the rotation (yaw: Quatro) [chosen]"""


class RefineConfig(Section):
    """Coarse-to-fine GICP."""

    voxel_m: Positive = 0.5
    """voxel size of the registered clouds (m) [chosen on KITTI 00]"""
    correspondence_m: tuple[Positive, ...] = Field((1.0, 0.5), min_length=1)
    """search distance of each stage (m) [chosen on KITTI 00]"""


class VerifyConfig(Section):
    """Conditions under which a registered pose is accepted."""

    max_false_share: float = Field(0.001, gt=0, lt=0.5)
    """share of false ones among the loops that are accepted, by what was measured on pairs of scans [the user's
    choice]"""


class GraphConfig(Section):
    """Noise of odometry and closures, and the optimisation of the pose graph."""

    final: Literal["none", "gnc", "consistent"] = "consistent"
    """final optimisation: `none` keeps the robust kernel, `gnc` uses graduated non-convexity, `consistent` starts from
    the largest pairwise-consistent set of closures [chosen on simulated drives]"""
    error_allowance: float = Field(3.0, ge=1)
    """tolerated ratio of real to modelled errors in the final optimisation; raise it for an odometry that is worse than
    KISS-ICP [chosen]"""
    odometry_sigma_m: Positive = 0.01
    """translation noise of the odometry per square root of a metre travelled [measured: simulated streets]"""
    odometry_sigma_deg: Positive = 0.02
    """rotation noise of the odometry per square root of a metre travelled [measured: simulated streets]"""
    robust: Literal["none", "huber", "cauchy", "geman-mcclure"] = "cauchy"
    """robust kernel of the closures before the final optimisation [chosen]"""


class AdjustmentConfig(Section):
    """Adjustment of the whole map after the loops: submaps are registered with each other."""

    max_minutes: NotNegative = 60.0
    """time limit, after which the registrations so far are used; 0: off (minutes) [chosen]"""
    rounds: int = Field(2, ge=1, le=5)
    """number of times that submaps are built and registered if a vertical angle is corrected, else 1 [chosen on KITTI
    00]"""


class MapConfig(Section):
    """The map that `--map` and `segslam export` make of a run."""

    voxel_m: float = Field(0.2, ge=0.02, le=5)
    """voxel size; the map has one point per voxel (m) [chosen]"""
    color: Literal["class", "height", "intensity"] = "class"
    """meaning of the colours; intensities are stored only in runs mapped with `intensity` [chosen]"""
    max_range_m: float = Field(50.0, gt=0, le=300)
    """points farther from their keyframe are dropped (m) [chosen]"""
    view_range_m: NotNegative = 30.0
    """distance within which keyframes can see through a voxel; 0: no voxel is removed (m) [chosen]"""


class Config(Section):
    """All sections; the representation shows the settings that differ from the defaults."""

    def __repr__(self) -> str:
        default = Config()
        changed = (
            f"{name}.{key}={value!r}"
            for name, section in self
            for key, value in section
            if value != getattr(getattr(default, name), key)
        )
        return f"Config({', '.join(changed)})"

    __str__ = __repr__

    sensor: SensorCalibrationConfig = SensorCalibrationConfig()
    odometry: OdometryConfig = OdometryConfig()
    health: HealthConfig = HealthConfig()
    keyframes: KeyframeConfig = KeyframeConfig()
    proximity: ProximityConfig = ProximityConfig()
    retrieval: RetrievalConfig = RetrievalConfig()
    segregator: SegregatorConfig = SegregatorConfig()
    refine: RefineConfig = RefineConfig()
    verify: VerifyConfig = VerifyConfig()
    graph: GraphConfig = GraphConfig()
    adjustment: AdjustmentConfig = AdjustmentConfig()
    map: MapConfig = MapConfig()
