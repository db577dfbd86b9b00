"""All settings: their sections (with units, ranges and sources), read from YAML files and texts `section.key=value`.

The YAML of files and of `--set` may be damaged or malicious.
"""

import logging
import re
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ValidationError

from segslam.core.config.sections import USER_SETTINGS as USER_SETTINGS
from segslam.core.config.sections import Config
from segslam.core.config.sections import GraphConfig as GraphConfig
from segslam.core.config.sections import KeyframeConfig as KeyframeConfig
from segslam.core.config.sections import LabelName as LabelName
from segslam.core.config.sections import MapConfig as MapConfig
from segslam.core.config.sections import OdometryConfig as OdometryConfig
from segslam.core.config.sections import ProximityConfig as ProximityConfig
from segslam.core.config.sections import RefineConfig as RefineConfig
from segslam.core.config.sections import Section as Section
from segslam.core.config.sections import SegregatorConfig as SegregatorConfig
from segslam.core.config.sections import SensorCalibrationConfig as SensorCalibrationConfig
from segslam.core.config.sections import VerifyConfig as VerifyConfig
from segslam.core.errors import SegslamError, brief
from segslam.core.whole_files import expanded, read_text

logger = logging.getLogger(__name__)
Model = TypeVar("Model", bound=BaseModel)

REMOVED = {
    "adjustment": "every steps radius_m reach min_overlap",
    "geometric": (
        "band_m car_length_m car_max_width_m car_top_m ground_cell_m ground_height_m max_range_m max_slope "
        "max_things min_points pole_clear_m pole_core_m pole_min_m pole_min_share trunk_max_m trunk_min_m "
        "wall_min_top_m wall_thickness_m"
    ),
    "graph": "systematic_drift turn_m closure_sigma_m closure_sigma_deg inlier_probability",
    "health": (
        "tolerance_m tolerance_deg watch_scans map_scans map_spacing_m map_spacing_deg correspondence_m "
        "inlier_m min_overlap max_rms"
    ),
    "keyframes": "dense_voxels max_gathered angle_deg",
    "log": "view_every compression",
    "map": "view_margin_m view_margin_ratio min_views moved_radius_m cell_m min_obstacle_voxels obstacle_m",
    "odometry": "stamp_tolerance_s",
    "proximity": (
        "base_height_m height_ratio base_turn_deg turn_ratio_deg break_radius_m max_candidates spread_m min_gap_m "
        "max_radius_m drift_ratio"
    ),
    "refine": "max_iterations max_range_m min_points information_scale shared_noise_m shared_noise_deg",
    "segregator": (
        "foot_max_distance_m few_clusters dcvc_start_radius_m dcvc_radius_step_m dcvc_azimuth_deg min_range_m "
        "max_range_m tuple_similarity tuple_trials_per_pair tuple_seed clique_max_nodes certain_inliers "
        "centroid_noise_m centroid_noise_share shared_noise_m shared_noise_deg ground_noise_m ground_weight "
        "gnc_factor gnc_max_iterations gnc_cost_tolerance feature_classes"
    ),
    "verify": (
        "min_overlap max_residual_ratio min_weak_support min_second_support max_free_space_violation "
        "max_violation_ratio well_observed rival_ratio max_hypotheses max_plan_hypotheses max_coarse_fine_m "
        "min_inliers inlier_m max_range_m free_space_margin_m free_space_margin_ratio max_rivals prior_gate"
    ),
}
"""Settings of older versions, by section: they are ignored with a warning, also in files and `--set`."""

MOST_NAMED = 3
"""Number of settings that a warning names."""
MOST_LEVELS = 100
"""Chosen: brackets around a bracket of a YAML text. YAML's scanner looks far ahead and at all of them each time."""


class _Loader(yaml.SafeLoader):
    """Rejects duplicate keys, of which YAML's own loader uses the last, and aliases, which multiply a short text."""

    def fetch_flow_collection_start(self, token_class: Any) -> None:
        """As in the base class. Raises ScannerError, with its line, for a bracket within too many others."""
        if self.flow_level >= MOST_LEVELS:
            raise yaml.scanner.ScannerError(None, None, "nested too deeply", self.get_mark())
        super().fetch_flow_collection_start(token_class)

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        """As in the base class. Raises ComposerError, with its line, for an alias."""
        if self.check_event(yaml.AliasEvent):
            event = self.peek_event()
            raise yaml.composer.ComposerError(None, None, f"*{event.anchor}: write the value itself", event.start_mark)
        return super().compose_node(parent, index)

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """As in the base class. Raises ConstructorError, with its line, for a duplicate key."""
        seen: set[str] = set()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode):
                raise yaml.constructor.ConstructorError(None, None, "a key must be a name", key.start_mark)
            if key.value in seen:
                raise yaml.constructor.ConstructorError(None, None, f"{key.value} is given twice", key.start_mark)
            seen.add(key.value)
        return super().construct_mapping(node, deep)


def _integer(loader: _Loader, node: yaml.ScalarNode) -> int | str:
    """The number, or the text itself where YAML 1.1 has base 60 or 8: the scans `10:30`, the sequence `010`."""
    return node.value if re.search(r":|^[-+]?0\d", node.value) else loader.construct_yaml_int(node)


_Loader.add_constructor("tag:yaml.org,2002:int", _integer)


def parse_yaml(text: str, source: str) -> Any:
    """The value of a YAML text. Raises SegslamError, naming the source, for an invalid text."""
    try:
        return yaml.load(text, _Loader)
    except RecursionError as error:
        raise SegslamError(f"{source}: not valid YAML (nested too deeply)") from error
    except (yaml.YAMLError, ValueError, ArithmeticError) as error:
        # The errors after the first are those of dates and numbers that do not exist, such as 2001-99-99 or 0x_.
        raise SegslamError(f"{source}: not valid YAML ({brief(str(error), 300)})") from error


def short(value: Any) -> str:
    """The value as in Python, cut to 80 characters."""
    try:
        return brief(repr(value))
    except ValueError:  # Python writes no number of more than 4300 digits
        return f"a {type(value).__name__} with too many digits"


def load_config(path: Path | str | None = None, overrides: Sequence[str] = (), *, base: Config | None = None) -> Config:
    """The defaults, or `base`, changed by a YAML file and then by `section.key=value` texts.

    Raises SegslamError, naming the file and key, for unreadable YAML, unknown keys and values out of range.
    """
    check_config(base)
    values = base.model_dump(mode="json") if base else {}
    given = _parse_yaml(read_text(expanded(path), "configuration", "give a YAML file"), str(path)) if path else {}
    for name, section in given.items():
        known = values.get(name)
        values[name] = known | section if isinstance(known, dict) and isinstance(section, dict) else section
    overrides = setting_texts(overrides)
    source = " and ".join([*([str(path)] if path else []), *(["--set"] if overrides or not path else [])])
    overridden = with_overrides(values, overrides, source=source, example="keyframes.distance_m=1.5")
    return validated(Config, _without_removed(overridden, source), source)


def check_config(config: Config | None) -> None:
    """Raises SegslamError for settings that are neither a Config nor None."""
    if not isinstance(config, Config | None):
        raise SegslamError(f"config: {brief(str(config))} is not a Config; give one, for example load_config(FILE)")


def setting_texts(settings: str | Iterable[str]) -> list[str]:
    """The `section.key=value` texts, of which one may be given alone. Raises SegslamError for anything else."""
    texts = list(settings) if isinstance(settings, Iterable) and not isinstance(settings, str) else [settings]
    if not all(isinstance(text, str) for text in texts):
        raise SegslamError(f"settings {short(settings)}: give texts, each section.key=value")
    return texts


def with_overrides(values: dict[str, Any], overrides: Sequence[str], *, source: str, example: str) -> dict[str, Any]:
    """The values of sections, changed by `section.key=value` texts; `source` and `example` are for messages."""
    changed = dict(values)
    for text in overrides:
        key, separator, value = text.partition("=")
        section, _, name = key.strip().partition(".")
        if not separator or not name:
            raise SegslamError(f"--set {brief(text)}: write section.key=value, for example {example}")
        known = changed.get(section, {})
        if not isinstance(known, dict):
            raise SegslamError(f"{source}: {section}: expected a section with keys, found {short(known)}")
        changed[section] = known | {name: parse_yaml(value, f"--set {brief(text)}")}
    return changed


def validated(model: type[Model], values: Any, source: str) -> Model:
    """The settings of a model from their values. Raises SegslamError, naming `source` and the key, for invalid ones."""
    try:
        return model.model_validate(values)
    except ValidationError as error:
        first = error.errors()[0]
        key = brief(".".join(str(part) for part in first["loc"]))
        if first["type"] == "extra_forbidden":
            fields = model.model_fields
            if len(first["loc"]) > 1 and (section := fields.get(str(first["loc"][0]))) is not None:
                fields = getattr(section.annotation, "model_fields", fields)
            known = ", ".join(fields) or "none"
            raise SegslamError(f"{source}: unknown key {key}; known keys: {known}") from error
        message = brief(first["msg"].removeprefix("Value error, "), 300)
        got = "" if isinstance(first["input"], dict) else f", got {short(first['input'])}"
        raise SegslamError(f"{source}: {key + ': ' if key else ''}{message}{got}") from error


def config_to_yaml(config: Config) -> str:
    """All settings as YAML, from which `load_config` makes an equal Config."""
    return yaml.safe_dump(config.model_dump(mode="json"), sort_keys=False)


def changed_settings(before: Config, now: Config) -> Iterator[tuple[str, Any, Any]]:
    """`section.key` and its two values, as in YAML, of each setting that differs."""
    old, new = before.model_dump(mode="json"), now.model_dump(mode="json")
    for section, values in new.items():
        for key, value in values.items():
            if value != old[section][key]:
                yield f"{section}.{key}", old[section][key], value


def config_from_yaml(text: str, source: str) -> Config:
    """The Config in a text of this or an older version; `source` is its name in messages.

    Settings that no longer exist are ignored with a warning. Raises SegslamError if the text is not a Config.
    """
    known: dict[str, Any] = {}
    gone: list[str] = []
    for name, section in _parse_yaml(text, source).items():
        if name not in Config.model_fields:
            gone.append(name)
        else:
            fields = type(getattr(Config(), name)).model_fields
            gone += [f"{name}.{key}" for key in section if key not in fields]
            known[name] = {key: value for key, value in section.items() if key in fields}
    if gone:
        more = f" and {len(gone) - MOST_NAMED} more" if len(gone) > MOST_NAMED else ""
        named = ", ".join(gone[:MOST_NAMED])
        logger.warning("%s: ignored settings that this version does not have: %s%s", source, named, more)
    return validated(Config, known, source)


def _without_removed(values: dict[str, Any], source: str) -> dict[str, Any]:
    """The values without settings of older versions that no longer exist."""
    all_gone: list[str] = []
    kept = dict(values)
    for section, names in REMOVED.items():
        given = values.get(section)
        if isinstance(given, dict):
            kept[section] = {name: value for name, value in given.items() if name not in names.split()}
            all_gone += [f"{section}.{name}" for name in given if name not in kept[section]]
            if not kept[section] and section not in Config.model_fields:
                del kept[section]
    if all_gone:
        verbs = "no longer exists and is" if len(all_gone) == 1 else "no longer exist and are"
        logger.warning("%s: %s %s ignored", source, ", ".join(all_gone), verbs)
    return kept


def _parse_yaml(text: str, source: str) -> dict[str, Any]:
    values = parse_yaml(text, source)
    if values is None:
        return {}
    if not isinstance(values, dict):
        raise SegslamError(f"{source}: expected sections with keys, found {short(values)}")
    for name, section in values.items():
        if name in Config.model_fields and not isinstance(section, dict | None):
            raise SegslamError(f"{source}: {name}: expected a section with keys, found {short(section)}")
    return {name: {} if section is None else section for name, section in values.items()}
