"""All settings: their sections, with units, ranges and sources (`sections`), and their YAML (`files`)."""

from segslam.core.config.files import changed_settings, config_from_yaml, config_to_yaml, load_config
from segslam.core.config.sections import (
    USER_SETTINGS,
    AdjustmentConfig,
    Config,
    GraphConfig,
    HealthConfig,
    KeyframeConfig,
    LabelName,
    MapConfig,
    OdometryConfig,
    ProximityConfig,
    RefineConfig,
    Section,
    SegregatorConfig,
    SensorCalibrationConfig,
    VerifyConfig,
)

__all__ = [
    "USER_SETTINGS",
    "AdjustmentConfig",
    "Config",
    "GraphConfig",
    "HealthConfig",
    "KeyframeConfig",
    "LabelName",
    "MapConfig",
    "OdometryConfig",
    "ProximityConfig",
    "RefineConfig",
    "Section",
    "SegregatorConfig",
    "SensorCalibrationConfig",
    "VerifyConfig",
    "changed_settings",
    "config_from_yaml",
    "config_to_yaml",
    "load_config",
]
