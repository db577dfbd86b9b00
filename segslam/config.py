"""Every parameter, with unit, range and source. Unknown keys are refused with their path; the defaults are complete.

P marks a value of the Segregator paper (Yin et al., ICRA 2023), A one of its authors' program.
"""

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import yaml
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    PlainSerializer,
    ValidationError,
    model_validator,
)

from segslam.types import Label, SegslamError

logger = logging.getLogger(__name__)


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
        raise ValueError("only labelled things that stay where they are help to recognise a place")
    return label


StaticLabel = Annotated[LabelName, AfterValidator(_check_static)]


class Section(BaseModel):
    """What all sections share: they cannot be changed, and refuse unknown keys."""

    model_config = ConfigDict(frozen=True, extra="forbid", validate_default=True)


class OdometryConfig(Section):
    """KISS-ICP's own parameters, under its own names."""

    max_range_m: float = Field(100.0, gt=0, description="points farther away are dropped (m)")
    min_range_m: float = Field(3.0, ge=0, description="points nearer than this are dropped: the car's own roof (m)")
    voxel_size_m: float = Field(1.0, gt=0, description="edge of the local map's voxels (m)")
    deskew: bool = Field(True, description="compensate the motion within a sweep, where points carry times")
    max_num_threads: int = Field(
        0, ge=0, description="of KISS-ICP, for the process; 0: all, poses repeat to 1e-9 m; 1: to the bit"
    )
    stamp_tolerance_s: float = Field(0.01, ge=0, description="a given pose this near in time is the scan's (s)")


class KeyframeConfig(Section):
    """When a keyframe is cut, and how much of it is kept."""

    distance_m: float = Field(2.0, gt=0, description="cut a keyframe this far from the last (m)")
    angle_deg: float = Field(20.0, gt=0, le=180, description="or after this turn (degrees)")
    voxel_m: float = Field(0.2, gt=0, description="thinning of a keyframe, cluster classes excepted (m)")
    resolution_m: float = Field(0.004, gt=0, description="rounding of a keyframe: 16 bits must log it (m)")


class ProximityConfig(Section):
    """Where loops are looked for."""

    min_travel_m: float = Field(50.0, ge=0, description="travel between the two ends of a loop (m)")
    base_radius_m: float = Field(6.0, gt=0, description="search radius without any drift (m)")
    drift_ratio: float = Field(0.015, ge=0, description="growth of the radius per metre of chain between the two")
    max_radius_m: float = Field(20.0, gt=0, description="the radius never exceeds this (m)")
    height_factor: float = Field(2.0, gt=0, description="greatest difference of heights, in search radii")
    max_candidates: int = Field(2, ge=1, description="candidates proposed per keyframe")
    spread_m: float = Field(8.0, ge=0, description="travel between two candidates of one keyframe (m)")
    min_gap_m: float = Field(8.0, ge=0, description="no new search within this travel of an accepted loop (m)")


def _check_rising(bounds: tuple[float, float]) -> tuple[float, float]:
    if not 0 <= bounds[0] < bounds[1]:
        raise ValueError("write the lower bound, at least 0, and then the upper one")
    return bounds


Bounds = Annotated[tuple[float, float], AfterValidator(_check_rising)]


class GeometricLabelsConfig(Section):
    """Labelling by shape alone. Heights are above the ground."""

    max_range_m: float = Field(70.0, gt=0, le=200, description="points farther away stay unlabelled (m)")
    ground_cell_m: float = Field(1.0, ge=0.2, description="edge of the cells of the ground's surface (m)")
    max_slope: float = Field(0.2, gt=0, description="steepest that the ground rises between cells")
    ground_height_m: float = Field(0.15, gt=0, description="points lower than this are ground (m)")
    band_m: Bounds = Field((0.4, 2.6), description="where poles and small solids are looked for (m)")
    min_points: int = Field(4, ge=1, description="fewest points of a pole, small solid or car within the band")
    max_things: int = Field(30, ge=1, description="of each of these classes, those with most points")
    pole_core_m: float = Field(0.4, gt=0, description="a pole lies within this radius (m)")
    pole_clear_m: float = Field(0.8, gt=0, description="and nothing else within this one (m)")
    pole_min_m: float = Field(1.0, gt=0, description="least height of a pole within the band (m)")
    pole_min_share: float = Field(0.7, gt=0, le=1, description="share of its occupied heights that stand clear")
    trunk_max_m: float = Field(1.6, gt=0, description="longest small solid: young trees, bushes, signs (m)")
    trunk_min_m: float = Field(1.6, gt=0, description="lowest top of a small solid (m)")
    car_top_m: Bounds = Field((1.0, 2.1), description="lowest and highest top of a car (m)")
    car_length_m: Bounds = Field((1.0, 6.0), description="shortest and longest side seen of a car (m)")
    car_max_width_m: float = Field(2.4, gt=0, description="widest car (m)")
    wall_thickness_m: float = Field(0.16, gt=0, description="standard deviation of a wall's points across it (m)")
    wall_min_top_m: float = Field(1.8, gt=0, description="lowest top of a wall: hedges are lower (m)")


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
        description="class -> fewest points of a cluster; these classes give clusters (P: L_SC; A: car 30, trunk 15)",
    )
    max_clusters_per_class: int = Field(
        24, ge=3, description="of a class, those with the largest surface seen; bounds the time of matching"
    )
    foot_classes: tuple[StaticLabel, ...] = Field(
        (Label.TRUNK, Label.POLE, Label.TRAFFIC_SIGN),
        description="upright things: their clusters are placed on the ground beneath, not at their centre",
    )
    foot_max_distance_m: float = Field(10.0, gt=0, description="the ground is looked for as far as this (m)")
    dcvc_start_radius_m: float = Field(0.35, ge=0.01, description="first radial bin of DCVC (A) (m)")
    dcvc_radius_step_m: float = Field(0.0004, ge=0, description="shrinking of each further radial bin (A) (m)")
    dcvc_pitch_deg: float = Field(
        2.0, ge=0.1, le=90, description="pitch bin of DCVC, no narrower than beams are apart (A: 1.2) (degrees)"
    )
    dcvc_azimuth_deg: float = Field(1.2, ge=0.1, le=90, description="azimuth bin of DCVC (A) (degrees)")
    min_range_m: float = Field(0.5, ge=0, description="nearest point clustered (A) (m)")
    max_range_m: float = Field(120.0, gt=0, le=1000, description="farthest point clustered (A) (m)")
    feature_classes: tuple[StaticLabel, ...] = Field(
        (Label.BUILDING, Label.VEGETATION), description="classes that give FPFH key points (P: L_F)"
    )
    feature_voxel_m: float = Field(0.35, ge=0.01, description="voxel of the class clouds (A: 0.5) (m)")
    normal_radius_m: float = Field(
        0.7, gt=0, description="of the patch that gives a point's normal and Gaussian (A: 1.0) (m)"
    )
    feature_radius_m: float = Field(2.0, gt=0, description="neighbourhood of FPFH (A: 2.5) (m)")
    max_features_per_class: int = Field(
        750, ge=1, description="key points of a class: those with most neighbours; 1,500 in all take 175 kB"
    )
    tuple_similarity: float = Field(0.95, gt=0, lt=1, description="edge ratio of the tuple test (A)")
    tuple_trials_per_pair: int = Field(100, ge=1, description="random triples drawn for each mutual pair (A)")
    tuple_seed: int = Field(0, ge=0, description="of the random triples")
    features: Literal["always", "when_few_clusters", "never"] = Field(
        "when_few_clusters", description="when a scan is given FPFH key points"
    )
    few_clusters: int = Field(24, ge=0, description="fewer clusters than this are few")
    gate: Literal["published", "invariant", "lengths"] = Field(
        "invariant", description="G-TRIM as published, with eigenvalues (rotation-invariant), or lengths only (Segator)"
    )
    noise_bounds_m: tuple[Annotated[float, Field(gt=0)], ...] = Field(
        (0.2, 0.4),
        min_length=1,
        description="bounds of one measurement (P, A: 0.2), the next tried if the pose is uncertain; lengths differ by "
        "twice as much at most (m)",
    )
    shape_bound_m2: float = Field(0.3, gt=0, description="G-TRIM: greatest squared Wasserstein shape distance (m^2)")
    min_clique: int = Field(3, ge=3, description="smallest inlier clique accepted")
    clique_max_nodes: int = Field(200_000, ge=1, description="search nodes after which the best so far is kept")
    max_cliques: int = Field(8, ge=1, description="maximum cliques tried at each bound until a pose is certain")
    certain_inliers: int = Field(12, ge=1, description="inliers that make a pose certain: nothing else is tried then")
    solver: Literal["gaussians", "joint", "decoupled"] = Field(
        "gaussians",
        description="joint: rotation and translation together; decoupled: one after the other (A); gaussians: joint, "
        "then clusters and ground laid on each other with their own covariances",
    )
    rotation: Literal["full", "yaw"] = Field("full", description="degrees of freedom of the rotation (yaw: Quatro)")
    centroid_noise_m: float = Field(0.07, gt=0, description="a centroid's noise in each direction (m)")
    centroid_noise_share: float = Field(
        0.35, ge=0, description="and as a share of its cluster's standard deviation in that direction"
    )
    shared_noise_m: float = Field(
        0.045, ge=0, description="noise that all share, being seen from one side; in the information alone (m)"
    )
    shared_noise_deg: float = Field(
        0.05, ge=0, description="the same of the rotation, as of a sensor's bent rays (degrees)"
    )
    ground_noise_m: float = Field(0.1, gt=0, description="noise of the distance of two patches of the ground (m)")
    ground_weight: float = Field(0.3, ge=0, description="weight of such a distance: neighbours err alike")
    gnc_factor: float = Field(1.4, gt=1, description="growth of GNC's control parameter (A)")
    gnc_max_iterations: int = Field(100, ge=1, description="(A)")
    gnc_cost_tolerance: float = Field(1e-6, gt=0, description="stop at this change of cost (A)")

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

    voxel_m: float = Field(0.5, gt=0, description="voxel of the clouds that are aligned (m)")
    correspondence_m: tuple[float, ...] = Field((1.0, 0.5), description="search distance, stage by stage (m)")
    max_iterations: int = Field(20, ge=1, description="in each stage")
    max_range_m: float = Field(60.0, gt=0, description="points farther away are left out (m)")
    min_points: int = Field(100, ge=10, description="fewest points, and fewest pairs, that can be aligned")
    information_scale: float = Field(
        0.05, gt=0, description="Hessian to information, for neighbours err alike: calibrated on simulated truth"
    )
    shared_noise_m: float = Field(
        0.026, ge=0, description="noise of the translation that all points share: a sensor's bent rays (m)"
    )
    shared_noise_deg: float = Field(0.067, ge=0, description="the same of the rotation (degrees)")


class VerifyConfig(Section):
    """When an alignment is believed."""

    max_hypotheses: int = Field(3, ge=1, description="coarse poses tried, the best first")
    max_plan_hypotheses: int = Field(
        2, ge=0, description="after these, poses tried that lay the floor plans on one another"
    )
    min_inliers: int = Field(3, ge=0, description="clique members that agree with a coarse pose worth refining")
    min_overlap: float = Field(0.2, ge=0, le=1, description="share of standing points that meet the other surface")
    inlier_m: float = Field(0.5, gt=0, description="a point this near the other surface meets it (m)")
    max_range_m: float = Field(50.0, gt=0, description="points farther from the other sensor are out of its reach (m)")
    max_rms_m: float = Field(0.165, gt=0, description="of the points that meet, to the other surface's planes (m)")
    max_free_space_violation: float = Field(0.035, ge=0, le=1, description="share of points in space seen empty")
    free_space_margin_m: float = Field(1.0, gt=0, description="a point this far before a return violates it (m)")
    free_space_margin_ratio: float = Field(0.02, ge=0, description="and this much more per metre of range")
    max_coarse_fine_m: float = Field(2.0, gt=0, description="farthest that refinement may move (m)")
    prior_gate: float = Field(1.5, gt=0, description="distance from the prior, in search radii")


class GraphConfig(Section):
    """What odometry and closures are believed to err by, and how their graph is solved."""

    odometry_sigma_m: float = Field(0.01, gt=0, description="odometry's translation noise per metre^0.5 travelled")
    odometry_sigma_deg: float = Field(0.02, gt=0, description="odometry's rotation noise per metre^0.5 travelled")
    turn_m: float = Field(5.0, ge=0, description="a turn of one radian adds as much noise as this travel (m)")
    closure_sigma_m: float = Field(0.04, gt=0, description="least translation noise of a closure (m)")
    closure_sigma_deg: float = Field(0.08, gt=0, description="least rotation noise of a closure (degrees)")
    robust: Literal["none", "huber", "cauchy", "geman-mcclure"] = Field(
        "cauchy", description="kernel of the closures while running"
    )
    final: Literal["none", "gnc", "consistent"] = Field(
        "consistent", description="last optimisation: as before, or truncated; by GNC, or from closures that agree"
    )
    inlier_probability: float = Field(
        0.99, gt=0, lt=1, description="the truncated ones keep closures within this chi-square quantile"
    )
    error_allowance: float = Field(
        3.0,
        ge=1,
        description="of errors this many times as large as claimed: not every odometry is as good as KISS-ICP's",
    )
    systematic_drift: Literal["auto", "never"] = Field(
        "auto", description="turn back what leftover angles of the sensor bent, where held-out scans show it"
    )


class LogConfig(Section):
    """How the log is written."""

    view_every: int = Field(8, ge=1, description="every n-th point of a keyframe is drawn; all are kept for replay")
    compression: Literal["none", "lz4", "zstd"] = Field("zstd", description="of the chunks of the log")


class MapConfig(Section):
    """The map that `--map` and `segslam export` make of a run."""

    voxel_m: float = Field(0.2, ge=0.02, le=5, description="edge of the voxels, a point each (m)")
    max_range_m: float = Field(50.0, gt=0, le=300, description="points farther from their keyframe are left out (m)")
    color: Literal["class", "height", "intensity"] = Field(
        "class", description="what the colours of the cloud say; a run keeps intensities only if mapped with it"
    )
    view_range_m: float = Field(30.0, ge=0, description="keyframes nearer than this are asked; 0: none (m)")
    view_margin_m: float = Field(0.3, gt=0, description="a return this far behind a voxel saw through it (m)")
    view_margin_ratio: float = Field(0.01, ge=0, description="and this much more per metre of range")
    min_views: int = Field(3, ge=1, description="fewest keyframes that saw through what is removed")
    moved_radius_m: float = Field(0.8, ge=0, description="what has mostly removed voxels this near goes with them (m)")
    cell_m: float = Field(0.2, ge=0.05, le=4, description="edge of the cells of the occupancy grid (m)")
    obstacle_m: Bounds = Field((0.3, 2.0), description="heights above the ground where a voxel is an obstacle (m)")
    min_obstacle_voxels: int = Field(2, ge=1, description="fewest of them in an occupied cell")


class Config(Section):
    """All sections."""

    odometry: OdometryConfig = OdometryConfig()
    keyframes: KeyframeConfig = KeyframeConfig()
    proximity: ProximityConfig = ProximityConfig()
    geometric: GeometricLabelsConfig = GeometricLabelsConfig()
    segregator: SegregatorConfig = SegregatorConfig()
    refine: RefineConfig = RefineConfig()
    verify: VerifyConfig = VerifyConfig()
    graph: GraphConfig = GraphConfig()
    log: LogConfig = LogConfig()
    map: MapConfig = MapConfig()


def load_config(path: Path | None = None, overrides: Sequence[str] = (), *, base: Config | None = None) -> Config:
    """The defaults, or `base`, changed by a YAML file and then by `section.key=value` texts.

    Raises SegslamError that names the file and key for unreadable YAML, unknown keys and values out of range.
    """
    values = _changed(base.model_dump(mode="json") if base else {}, _read_yaml(path) if path else {})
    for text in overrides:
        key, separator, value = text.partition("=")
        section, dot, name = key.strip().partition(".")
        if not separator or not dot or not name:
            raise SegslamError(f"--set {text}: write it as section.key=value, for example keyframes.distance_m=1.5")
        section_values = values.setdefault(section, {})
        if not isinstance(section_values, dict):
            raise SegslamError(f"{path}: {section}: expected a section with keys, found {section_values!r}")
        try:
            section_values[name] = yaml.safe_load(value)
        except yaml.YAMLError as error:
            raise SegslamError(f"--set {text}: the value is no valid YAML ({_one_line(error)})") from error
    source = str(path) if path is not None else "--set"
    return _validate(values, source if not (path and overrides) else f"{path} and --set")


def config_to_yaml(config: Config) -> str:
    """Every setting as YAML that `load_config` reads back to an equal Config."""
    return yaml.safe_dump(config.model_dump(mode="json"), sort_keys=False)


def config_from_yaml(text: str, source: str) -> Config:
    """The Config that a text of this or an older version holds; `source` names it to a person.

    Settings that there are no longer are left out, with a warning. Raises SegslamError if it holds no Config.
    """
    known, gone = _known(_parse_yaml(text, source))
    if gone:
        logger.warning("%s: left out what this version does not have: %s", source, ", ".join(gone))
    return _validate(known, source)


def _known(values: dict[str, Any]) -> tuple[dict[str, Any], list[str]]:
    """The settings that this version has, and the names of the others."""
    known: dict[str, Any] = {}
    gone: list[str] = []
    for name, section in values.items():
        if name not in Config.model_fields:
            gone.append(name)
        elif isinstance(section, dict):
            fields = type(getattr(Config(), name)).model_fields
            gone += [f"{name}.{key}" for key in section if key not in fields]
            known[name] = {key: value for key, value in section.items() if key in fields}
        else:
            known[name] = section
    return known, gone


def _changed(values: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    """The values of all sections, with those keys replaced that the changes name."""
    keywise = {
        name: values[name] | section
        for name, section in changes.items()
        if isinstance(section, dict) and isinstance(values.get(name), dict)
    }
    return values | changes | keywise


def _read_yaml(path: Path) -> dict[str, Any]:
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise SegslamError(f"{path}: cannot read the configuration ({error}); name a YAML file") from error
    return _parse_yaml(text, str(path))


def _parse_yaml(text: str, source: str) -> dict[str, Any]:
    try:
        values = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise SegslamError(f"{source}: no valid YAML ({_one_line(error)})") from error
    if values is None:
        return {}
    if not isinstance(values, dict):
        raise SegslamError(f"{source}: expected sections with keys, found {type(values).__name__}")
    return values


def _validate(values: dict[str, Any], source: str) -> Config:
    try:
        return Config.model_validate(values)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        if first["type"] == "extra_forbidden":
            raise SegslamError(f"{source}: unknown key {key}; {_known_keys(first['loc'])}") from error
        raise SegslamError(f"{source}: {key}: {first['msg']}, got {first['input']!r}") from error


def _known_keys(location: tuple[int | str, ...]) -> str:
    fields = Config.model_fields
    if len(location) > 1 and location[0] in fields:
        section = fields[str(location[0])].annotation
        if isinstance(section, type) and issubclass(section, Section):
            fields = section.model_fields
    return "known here: " + (", ".join(fields) or "none")


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())
