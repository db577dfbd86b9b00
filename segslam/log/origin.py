"""How a run was made: the metadata of its log."""

import json
import platform
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version

from segslam.config import Config, config_to_yaml
from segslam.log import schema
from segslam.types import Transform

PACKAGES = ("segslam", "numpy", "gtsam", "kiss-icp", "open3d", "small-gicp", "numba", "scipy", "mcap")
"""Whose versions a log records: those that its figures depend on."""


def metadata(
    config: Config, dataset: str, T_camera_lidar: Transform | None, options: Mapping[str, str]
) -> dict[str, dict[str, str]]:
    """Records by name; what each holds is said in `schema`."""
    calibration = {} if T_camera_lidar is None else {"T_camera_lidar": json.dumps(T_camera_lidar.tolist())}
    return {
        schema.RUN_METADATA: {
            "schema_version": str(schema.VERSION),
            "dataset": dataset,
            "python": platform.python_version(),
            "platform": platform.platform(),
            **calibration,
        },
        schema.CONFIG_METADATA: {"yaml": config_to_yaml(config)},
        schema.OPTIONS_METADATA: dict(options),
        schema.PACKAGES_METADATA: {name: _version(name) for name in PACKAGES},
    }


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:  # open3d has other distributions of the same import
        return "not installed"
