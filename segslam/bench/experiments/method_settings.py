"""Names of the methods, and the settings of those that are variants of Segregator. Imports quickly."""

from typing import TYPE_CHECKING, Any

from segslam.core.errors import SegslamError

if TYPE_CHECKING:
    from segslam.core.config import Config

FPFH_ONLY: dict[str, Any] = {
    "gate": "lengths",
    "features": "always",
    "cluster_min_points": {},
    "feature_voxel_m": 0.5,
    "normal_radius_m": 1.0,
    "feature_radius_m": 2.5,
    "noise_bounds_m": (0.2,),
    "max_cliques": 1,
    "solver": "decoupled",
}
"""Point features alone with TEASER's solver; radii and bound of Segregator's authors (Yin et al., ICRA 2023)."""
SEGREGATOR_SETTINGS: dict[str, dict[str, Any]] = {
    "segregator": {},
    "segregator-c2f": {},
    "segator": {"gate": "lengths"},
    "teaser": FPFH_ONLY,
    "quatro": FPFH_ONLY | {"rotation": "yaw"},
}
"""Settings of section `segregator` by method."""
METHOD_NAMES = (*SEGREGATOR_SETTINGS, "vgicp", "gicp", "kiss-matcher", "ransac", "fgr")


def check_method(name: str) -> None:
    """Raises SegslamError for an unknown method."""
    if name not in METHOD_NAMES:
        raise SegslamError(f"--method {name}: unknown method; known: {', '.join(METHOD_NAMES)}")


def method_config(config: "Config", method: str) -> "Config":
    """The configuration with the settings of a method."""
    changes = SEGREGATOR_SETTINGS.get(method, {})
    return config.model_copy(update={"segregator": config.segregator.model_copy(update=changes)})
