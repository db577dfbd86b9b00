"""Every parameter, with unit, range and, in square brackets, the source of its default. Unknown keys are refused.

Most users need `USER_SETTINGS` only. Sources: the Segregator paper (Yin et al., ICRA 2023), its authors' program, the
library that uses the value, measured (on what), or chosen (on what, where data decided).
"""

from typing import Annotated, Literal

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    PlainSerializer,
    model_validator,
)

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
    "proximity.max_radius_m",
    "verify.min_overlap",
    "verify.max_residual_ratio",
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


class Section(BaseModel):
    """Base of all sections: immutable; unknown keys, infinities and NaN are refused."""

    model_config = ConfigDict(frozen=True, extra="forbid", validate_default=True, allow_inf_nan=False)


class SensorCalibrationConfig(Section):
    """Calibration of the LiDAR, applied when its scans are read."""

    vertical_angle_deg: float | None = Field(
        None,
        ge=-5,
        le=5,
        description="elevation added to all points of a scan; positive if the sensor measures points too low; `null`: "
        "0.205 for data in KITTI's layout, 0 for all other data (degrees) [KISS-ICP, for KITTI]",
    )


class OdometryConfig(Section):
    """Parameters of KISS-ICP, under its own names."""

    max_range_m: float = Field(100.0, gt=0, description="points farther away are dropped (m) [KISS-ICP]")
    min_range_m: float = Field(
        3.0,
        ge=0,
        description="points nearer than this are dropped: returns from the vehicle itself (m) [chosen for KITTI's car]",
    )
    voxel_size_m: float = Field(1.0, gt=0, description="voxel size of KISS-ICP's local map (m) [KISS-ICP]")
    deskew: bool = Field(True, description="compensate the motion within a sweep, if the points have times [KISS-ICP]")
    max_num_threads: int = Field(
        0,
        ge=0,
        description="threads of KISS-ICP; 0: all cores, poses repeat to 1e-9 m; 1: poses repeat exactly [KISS-ICP]",
    )
    stamp_tolerance_s: float = Field(
        0.01, ge=0, description="largest time difference between a scan and its pose in a given trajectory (s) [chosen]"
    )

    @model_validator(mode="after")
    def _has_a_range(self) -> "OdometryConfig":
        if self.max_range_m <= self.min_range_m:
            raise ValueError(f"max_range_m {self.max_range_m:g} must be above min_range_m {self.min_range_m:g}")
        return self


class HealthConfig(Section):
    """Comparison of the odometry's motions with the scans."""

    check: bool = Field(
        True, description="compare the motions of the odometry with the scans, and keep more likely ones [chosen]"
    )


class KeyframeConfig(Section):
    """Selection of keyframes, and their resolution."""

    distance_m: float = Field(2.0, gt=0, description="distance between keyframes (m) [chosen]")
    voxel_m: float = Field(
        0.2,
        gt=0,
        description="voxel size to which keyframes are downsampled, except for the classes that form clusters (m) "
        "[chosen]",
    )
    angle_deg: float = Field(
        20.0,
        gt=0,
        le=180,
        description="rotation after which a keyframe is made before that distance is reached (degrees) [chosen]",
    )
    dense_voxels: int = Field(
        3000,
        ge=0,
        description="a keyframe with fewer voxels (refine.voxel_m) is matched together with its neighbours' points "
        "[chosen on KITTI, courtyard, NCLT]",
    )
    max_gathered: int = Field(
        10, ge=0, description="largest number of neighbouring keyframes whose points are merged [chosen]"
    )
    resolution_m: float = Field(
        0.004, gt=0, description="grid to which the coordinates of keyframes are rounded (m) [chosen]"
    )


class ProximityConfig(Section):
    """Search for loop candidates near the estimated position."""

    min_travel_m: float = Field(
        50.0, ge=0, description="smallest distance travelled between the two keyframes of a loop (m) [chosen]"
    )
    max_radius_m: float = Field(20.0, gt=0, description="largest search radius (m) [chosen on simulated drives]")
    base_radius_m: float = Field(6.0, gt=0, description="search radius without drift (m) [chosen on simulated drives]")
    drift_ratio: float = Field(
        0.015,
        ge=0,
        description="increase of the search radius per metre travelled between the two keyframes "
        "[chosen on KISS-ICP's drift in simulated drives]",
    )
    break_radius_m: float = Field(60.0, gt=0, description="search radius across a break of the odometry (m) [chosen]")
    base_height_m: float = Field(
        1.0,
        gt=0,
        description="largest height difference of two visits without drift (m) [chosen: storeys are 3 m apart]",
    )
    height_ratio: float = Field(
        0.008,
        ge=0,
        description="increase of that height difference per metre travelled between the two keyframes "
        "[chosen: ramps of 100 to 150 m]",
    )
    base_turn_deg: float = Field(
        15.0, gt=0, le=180, description="largest rotation between a loop and its prior without drift (degrees) [chosen]"
    )
    turn_ratio_deg: float = Field(
        0.02,
        ge=0,
        description="increase of that rotation per metre travelled between the two keyframes (degrees) [chosen]",
    )
    max_candidates: int = Field(2, ge=1, description="number of candidates per keyframe [chosen]")
    spread_m: float = Field(
        8.0, ge=0, description="smallest distance travelled between two candidates of one keyframe (m) [chosen]"
    )
    min_gap_m: float = Field(
        8.0, ge=0, description="distance travelled after an accepted loop before the next search (m) [chosen]"
    )


class RetrievalConfig(Section):
    """Loop closing by place recognition, independent of drift."""

    enabled: bool = Field(
        True, description="search loops also outside the search radius of proximity, by similarity of places [chosen]"
    )


def _check_rising(bounds: tuple[float, float]) -> tuple[float, float]:
    if not 0 <= bounds[0] < bounds[1]:
        raise ValueError("give the lower bound, at least 0, then the upper bound")
    return bounds


Bounds = Annotated[tuple[float, float], AfterValidator(_check_rising)]


class GeometricLabelsConfig(Section):
    """Labels from geometry alone. Heights are above the ground."""

    max_range_m: float = Field(70.0, gt=0, le=200, description="points farther away remain unlabelled (m) [chosen]")
    ground_cell_m: float = Field(1.0, ge=0.2, description="cell size of the ground surface (m) [chosen]")
    max_slope: float = Field(0.2, gt=0, description="largest slope of the ground between cells [chosen]")
    ground_height_m: float = Field(0.15, gt=0, description="points lower than this are ground (m) [chosen]")
    band_m: Bounds = Field(
        (0.4, 2.6), description="lowest and highest height in which poles and small solids are searched (m) [chosen]"
    )
    min_points: int = Field(
        4, ge=1, description="smallest number of points of a pole, small solid or car within the band [chosen]"
    )
    max_things: int = Field(
        30, ge=1, description="largest number of objects per class; those with most points are kept [chosen]"
    )
    pole_core_m: float = Field(0.4, gt=0, description="largest radius of a pole (m) [chosen]")
    pole_clear_m: float = Field(0.8, gt=0, description="radius around a pole without other points (m) [chosen]")
    pole_min_m: float = Field(1.0, gt=0, description="smallest height of a pole within the band (m) [chosen]")
    pole_min_share: float = Field(
        0.7, gt=0, le=1, description="smallest share of the heights of a pole without other points nearby [chosen]"
    )
    trunk_max_m: float = Field(
        1.6, gt=0, description="largest length of a small solid: young trees, bushes, signs (m) [chosen]"
    )
    trunk_min_m: float = Field(1.6, gt=0, description="smallest height of the top of a small solid (m) [chosen]")
    car_top_m: Bounds = Field((1.0, 2.1), description="lowest and highest top of a car (m) [chosen]")
    car_length_m: Bounds = Field((1.0, 6.0), description="shortest and longest visible side of a car (m) [chosen]")
    car_max_width_m: float = Field(2.4, gt=0, description="largest width of a car (m) [chosen]")
    wall_thickness_m: float = Field(
        0.16, gt=0, description="standard deviation of a wall's points across it (m) [chosen]"
    )
    wall_min_top_m: float = Field(
        1.8, gt=0, description="smallest height of the top of a wall; hedges are lower (m) [chosen]"
    )


class SegregatorConfig(Section):
    """Global registration from semantic clusters and point features."""

    cluster_min_points: dict[StaticLabel, Annotated[int, Field(ge=1)]] = Field(
        {
            Label.CAR: 6,
            Label.TRUCK: 6,
            Label.OTHER_VEHICLE: 6,
            Label.TRUNK: 4,
            Label.POLE: 4,
            Label.TRAFFIC_SIGN: 3,
        },
        description="classes that form clusters, and the smallest number of points of a cluster "
        "[paper: L_SC; authors: car 30, trunk 15; chosen]",
    )
    max_clusters_per_class: int = Field(
        24,
        ge=3,
        description="largest number of clusters per class; those with the largest visible surface are kept [chosen]",
    )
    foot_classes: tuple[StaticLabel, ...] = Field(
        (Label.TRUNK, Label.POLE, Label.TRAFFIC_SIGN),
        description="classes of upright objects: the position of their clusters is the foot on the ground [chosen]",
    )
    foot_max_distance_m: float = Field(
        10.0, gt=0, description="largest distance to the ground patch below such a cluster (m) [chosen]"
    )
    dcvc_start_radius_m: float = Field(0.35, ge=0.01, description="first radial bin of DCVC (m) [authors]")
    dcvc_radius_step_m: float = Field(0.0004, ge=0, description="shrinking of each further radial bin (m) [authors]")
    dcvc_pitch_deg: float = Field(
        2.0,
        ge=0.1,
        le=90,
        description="pitch bin of DCVC, at least the spacing of the beams (degrees) [authors: 1.2; chosen]",
    )
    dcvc_azimuth_deg: float = Field(1.2, ge=0.1, le=90, description="azimuth bin of DCVC (degrees) [authors]")
    min_range_m: float = Field(0.5, ge=0, description="nearest point clustered (m) [authors]")
    max_range_m: float = Field(120.0, gt=0, le=1000, description="farthest point clustered (m) [authors]")
    feature_classes: tuple[StaticLabel, ...] = Field(
        (Label.BUILDING, Label.VEGETATION), description="classes that give FPFH key points [paper: L_F]"
    )
    feature_voxel_m: float = Field(
        0.35, ge=0.01, description="voxel size of the class clouds (m) [authors: 0.5; chosen]"
    )
    normal_radius_m: float = Field(
        0.7,
        gt=0,
        description="radius of the patch from which the normal and the Gaussian of a point are computed (m) "
        "[authors: 1.0; chosen]",
    )
    feature_radius_m: float = Field(2.0, gt=0, description="neighbourhood of FPFH (m) [authors: 2.5; chosen]")
    max_features_per_class: int = Field(
        750,
        ge=1,
        description="largest number of key points per class; those with most neighbours are kept; 1,500 take 175 kB "
        "[chosen]",
    )
    tuple_similarity: float = Field(0.95, gt=0, lt=1, description="edge ratio of the tuple test [authors]")
    tuple_trials_per_pair: int = Field(100, ge=1, description="random triples drawn for each mutual pair [authors]")
    tuple_seed: int = Field(0, ge=0, description="random seed of these triples [chosen]")
    features: Literal["always", "when_few_clusters", "never"] = Field(
        "when_few_clusters", description="when FPFH key points are computed for a scan [chosen]"
    )
    few_clusters: int = Field(
        24, ge=0, description="number of clusters below which a scan has few clusters [chosen on simulated 00 and 08]"
    )
    gate: Literal["published", "invariant", "lengths"] = Field(
        "invariant",
        description="G-TRIM: published; invariant: with eigenvalues, invariant under rotation; lengths: lengths only "
        "[paper; chosen; Segator]",
    )
    noise_bounds_m: tuple[Annotated[float, Field(gt=0)], ...] = Field(
        (0.2, 0.4),
        min_length=1,
        description="noise bounds of a position, tried in order until the pose is certain; two lengths may differ by "
        "twice the bound (m) [paper and authors: 0.2; chosen: 0.4]",
    )
    shape_bound_m2: float = Field(
        0.3, gt=0, description="G-TRIM: largest squared Wasserstein distance between two shapes (m^2) [chosen]"
    )
    min_clique: int = Field(
        3, ge=3, description="size of the smallest clique of inliers that is accepted [chosen on simulated 00 and 08]"
    )
    clique_max_nodes: int = Field(
        200_000, ge=1, description="search nodes after which the search stops with the best clique found [chosen]"
    )
    max_cliques: int = Field(8, ge=1, description="largest number of maximum cliques tried at each bound [chosen]")
    certain_inliers: int = Field(
        12,
        ge=1,
        description="number of inliers above which a pose is certain and no other is tried "
        "[chosen on simulated 00 and 08]",
    )
    solver: Literal["gaussians", "joint", "decoupled"] = Field(
        "gaussians",
        description="joint: rotation and translation together; decoupled: one after the other; gaussians: joint, then "
        "refined by aligning clusters and ground, weighted by their covariances [authors: decoupled; chosen]",
    )
    rotation: Literal["full", "yaw"] = Field(
        "full", description="degrees of freedom of the rotation (yaw: Quatro) [chosen]"
    )
    centroid_noise_m: float = Field(
        0.07, gt=0, description="noise of a centroid in each direction (m) [measured: simulated truth]"
    )
    centroid_noise_share: float = Field(
        0.35,
        ge=0,
        description="additional noise of a centroid, as a share of its cluster's standard deviation "
        "[measured: simulated truth]",
    )
    shared_noise_m: float = Field(
        0.045,
        ge=0,
        description="noise common to all centroids, in the information matrix only (m) [measured: simulated truth]",
    )
    shared_noise_deg: float = Field(
        0.05,
        ge=0,
        description="rotation noise common to all centroids, for example from sensor calibration (degrees) "
        "[measured: simulated truth]",
    )
    ground_noise_m: float = Field(
        0.1, gt=0, description="noise of the distance between two ground patches (m) [chosen]"
    )
    ground_weight: float = Field(
        0.3,
        ge=0,
        description="weight of such a distance; below 1 because the errors of neighbours are correlated [chosen]",
    )
    gnc_factor: float = Field(1.4, gt=1, description="growth of GNC's control parameter [authors]")
    gnc_max_iterations: int = Field(100, ge=1, description="largest number of iterations of GNC [authors]")
    gnc_cost_tolerance: float = Field(1e-6, gt=0, description="change of cost at which GNC stops [authors]")

    @model_validator(mode="after")
    def _radial_bins_reach_the_range(self) -> "SegregatorConfig":
        reach_m = self.dcvc_start_radius_m**2 / max(2.0 * self.dcvc_radius_step_m, 1e-12)  # where a bin is 0 deep
        if reach_m < self.max_range_m:
            raise ValueError(
                f"DCVC's radial bins shrink to nothing at {reach_m:.0f} m: lower dcvc_radius_step_m or max_range_m"
            )
        return self


class RefineConfig(Section):
    """Coarse-to-fine GICP."""

    voxel_m: float = Field(0.5, gt=0, description="voxel size of the registered clouds (m) [chosen on KITTI 00]")
    correspondence_m: tuple[Annotated[float, Field(gt=0)], ...] = Field(
        (1.0, 0.5), min_length=1, description="search distance of each stage (m) [chosen on KITTI 00]"
    )
    max_iterations: int = Field(20, ge=1, description="largest number of iterations in each stage [small_gicp]")
    max_range_m: float = Field(60.0, gt=0, description="points farther away are dropped (m) [chosen]")
    min_points: int = Field(
        100, ge=10, description="smallest number of points, and of point pairs, for a registration [chosen on KITTI 00]"
    )
    information_scale: float = Field(
        0.05,
        gt=0,
        description="factor from the Hessian to the information matrix; below 1: errors of neighbours are correlated "
        "[measured: simulated truth]",
    )
    shared_noise_m: float = Field(
        0.026,
        ge=0,
        description="translation noise common to all points, for example from sensor calibration (m) "
        "[measured: simulated truth]",
    )
    shared_noise_deg: float = Field(
        0.067, ge=0, description="rotation noise common to all points (degrees) [measured: simulated truth]"
    )


class VerifyConfig(Section):
    """Conditions under which a registered pose is accepted."""

    min_overlap: float = Field(
        0.2,
        ge=0,
        le=1,
        description="smallest overlap: the share of points above the ground within reach that lie on the other scan "
        "[chosen on simulated 00 and 08]",
    )
    max_residual_ratio: float = Field(
        1.5,
        gt=0,
        description="largest residual of these points, relative to neighbouring keyframes "
        "[chosen on KITTI 00, courtyard, NCLT]",
    )
    max_hypotheses: int = Field(3, ge=1, description="number of coarse poses tried, the best first [chosen]")
    max_plan_hypotheses: int = Field(
        6, ge=0, description="number of poses tried after these, from aligning the two floor plans [chosen]"
    )
    min_inliers: int = Field(
        3, ge=0, description="smallest number of clique members consistent with a coarse pose [chosen]"
    )
    inlier_m: float = Field(
        0.5,
        gt=0,
        description="distance to the other scan within which a point overlaps it (m) [chosen: refine.voxel_m]",
    )
    min_weak_support: float = Field(
        0.2,
        ge=0,
        le=1,
        description="smallest share of matching points, relative to the overlap, among points facing the direction in "
        "which they constrain the pose least [chosen on courtyard and simulated corridors]",
    )
    min_second_support: float = Field(
        0.15,
        ge=0,
        le=1,
        description="the same without the surface that most of them match, for poses with an unobserved direction, "
        "scans that see one side only, and poses in narrow or badly observed places that fit less well than "
        "neighbouring keyframes; these need 1.3 times as much, with scans that see one side only twice as much "
        "[chosen on simulated corridors and tunnels]",
    )
    max_range_m: float = Field(
        50.0,
        gt=0,
        description="points farther from the other sensor are out of its reach (m) [chosen on simulated 00 and 08]",
    )
    max_free_space_violation: float = Field(
        0.035,
        ge=0,
        le=1,
        description="largest share of points in space that the other scan saw empty [chosen on simulated 00 and 08]",
    )
    max_violation_ratio: float = Field(
        5.0,
        ge=0,
        description="the same limit relative to neighbouring keyframes; the larger of the two limits holds [chosen]",
    )
    free_space_margin_m: float = Field(
        1.0,
        gt=0,
        description="distance before a return at which a point violates free space; less in narrow places (m) "
        "[chosen for KITTI's streets]",
    )
    free_space_margin_ratio: float = Field(
        0.02, ge=0, description="increase of that distance per metre of range [chosen]"
    )
    max_coarse_fine_m: float = Field(
        2.0, gt=0, description="largest correction of a coarse pose by refinement (m) [chosen]"
    )
    well_observed: float = Field(
        0.1,
        ge=0,
        le=1,
        description="a pose is compared with rivals if the ratio of the smallest to the largest variance of its "
        "translation is below this; if it also fits less well than neighbouring keyframes, more than one surface must "
        "confirm it (`min_second_support`) [chosen on KITTI 00]",
    )
    max_rivals: int = Field(
        6,
        ge=0,
        description="number of floor-plan poses tried as rivals, besides shifts along the weak direction [chosen]",
    )
    rival_ratio: float = Field(
        1.2,
        ge=1,
        description="a pose is ambiguous if a rival has less than this many times its mismatch "
        "[chosen on a simulated corridor and tunnel]",
    )
    prior_gate: float = Field(
        1.5, gt=0, description="largest horizontal distance from the prior, in search radii [chosen]"
    )


class GraphConfig(Section):
    """Noise of odometry and closures, and the optimisation of the pose graph."""

    final: Literal["none", "gnc", "consistent"] = Field(
        "consistent",
        description="final optimisation: `none` keeps the robust kernel, `gnc` uses graduated non-convexity, "
        "`consistent` starts from the largest pairwise-consistent set of closures [chosen on simulated drives]",
    )
    error_allowance: float = Field(
        3.0,
        ge=1,
        description="tolerated ratio of real to modelled errors in the final optimisation; raise it for an odometry "
        "that is worse than KISS-ICP [chosen]",
    )
    odometry_sigma_m: float = Field(
        0.01,
        gt=0,
        description="translation noise of the odometry per square root of a metre travelled "
        "[measured: simulated streets]",
    )
    odometry_sigma_deg: float = Field(
        0.02,
        gt=0,
        description="rotation noise of the odometry per square root of a metre travelled [measured: simulated streets]",
    )
    turn_m: float = Field(
        5.0,
        ge=0,
        description="distance whose noise equals that of a rotation by one radian (m) [measured: simulated streets]",
    )
    closure_sigma_m: float = Field(
        0.04, gt=0, description="smallest translation noise of a closure (m) [measured: simulated 06]"
    )
    closure_sigma_deg: float = Field(
        0.08, gt=0, description="smallest rotation noise of a closure (degrees) [measured: simulated 06]"
    )
    robust: Literal["none", "huber", "cauchy", "geman-mcclure"] = Field(
        "cauchy", description="robust kernel of the closures before the final optimisation [chosen]"
    )
    inlier_probability: float = Field(
        0.99,
        gt=0,
        lt=1,
        description="a closure is an inlier if its squared error is below this quantile of the chi-square distribution "
        "(6 degrees of freedom) [statistics]",
    )


class AdjustmentConfig(Section):
    """Adjustment of the whole map after the loops: submaps are registered with each other."""

    max_minutes: float = Field(
        60.0, ge=0, description="time limit, after which the registrations so far are used; 0: off (minutes) [chosen]"
    )
    rounds: int = Field(
        2, ge=1, le=5, description="number of times that submaps are built and registered [chosen on KITTI 00]"
    )
    every: int = Field(2, ge=1, description="a submap is registered for every n-th keyframe [chosen on KITTI 00]")
    reach: int = Field(
        2, ge=0, description="number of keyframes before and after one that are in its submap [chosen on KITTI 00]"
    )
    steps: tuple[Annotated[int, Field(ge=1)], ...] = Field(
        (5, 10),
        min_length=1,
        description="distances of registered submaps along the drive, in keyframes [chosen on KITTI 00]",
    )
    radius_m: float = Field(
        10.0, ge=0, description="largest distance of registered submaps of two passes (m) [chosen on KITTI 00]"
    )
    min_overlap: float = Field(
        0.1,
        ge=0,
        le=1,
        description="smallest share of a submap's points that lie on the other [chosen on KITTI 00]",
    )


class LogConfig(Section):
    """Format of the log."""

    view_every: int = Field(
        8, ge=1, description="viewers get every n-th point of a keyframe; replay uses all points [chosen]"
    )
    compression: Literal["none", "lz4", "zstd"] = Field("zstd", description="compression of the log [chosen]")


class MapConfig(Section):
    """The map that `--map` and `segslam export` make of a run."""

    voxel_m: float = Field(0.2, ge=0.02, le=5, description="voxel size; the map has one point per voxel (m) [chosen]")
    color: Literal["class", "height", "intensity"] = Field(
        "class",
        description="meaning of the colours; intensities are stored only in runs mapped with `intensity` [chosen]",
    )
    max_range_m: float = Field(
        50.0, gt=0, le=300, description="points farther from their keyframe are dropped (m) [chosen]"
    )
    view_range_m: float = Field(
        30.0,
        ge=0,
        description="distance within which keyframes can see through a voxel; 0: no voxel is removed (m) [chosen]",
    )
    view_margin_m: float = Field(
        0.3,
        gt=0,
        description="distance by which a return must lie behind a voxel to have passed through it (m) [chosen]",
    )
    view_margin_ratio: float = Field(0.01, ge=0, description="increase of that distance per metre of range [chosen]")
    min_views: int = Field(
        3, ge=1, description="smallest number of keyframes that see through a removed voxel [chosen]"
    )
    moved_radius_m: float = Field(
        0.8, ge=0, description="voxels with mostly removed neighbours within this radius are removed too (m) [chosen]"
    )
    cell_m: float = Field(0.2, ge=0.05, le=4, description="cell size of the occupancy grid (m) [chosen]")
    obstacle_m: Bounds = Field(
        (0.3, 2.0), description="heights above the ground where a voxel is an obstacle (m) [chosen]"
    )
    min_obstacle_voxels: int = Field(2, ge=1, description="smallest number of such voxels in an occupied cell [chosen]")


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
    geometric: GeometricLabelsConfig = GeometricLabelsConfig()
    segregator: SegregatorConfig = SegregatorConfig()
    refine: RefineConfig = RefineConfig()
    verify: VerifyConfig = VerifyConfig()
    graph: GraphConfig = GraphConfig()
    adjustment: AdjustmentConfig = AdjustmentConfig()
    log: LogConfig = LogConfig()
    map: MapConfig = MapConfig()
