"""Writes docs/options.md: every setting (unit, default, range, meaning), from segslam/core/config/sections.py.

python tools/options.py
"""

import re
from pathlib import Path
from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin

import yaml
from annotated_types import Ge, Gt, Le, Lt, MinLen
from pydantic.fields import FieldInfo

from segslam.core.config import USER_SETTINGS, Config, Section

PAGE = Path(__file__).resolve().parents[1] / "docs" / "options.md"
INTRODUCTION = """# Every setting

Generated from `segslam/core/config/sections.py` by `python tools/options.py`; do not edit this page.

Change settings with a YAML file that contains the differences from the defaults, `--config strict.yaml`, or one by one,
`--set verify.max_false_share=0.01 --set map.color=height`. Unknown keys and values out of range are
reported as errors. Each run stores its settings in `config.yaml`, which can be passed to `--config`.

```yaml
verify:
  max_false_share: 0.01
keyframes:
  distance_m: 1.5
```

The source of a default is the paper (Yin et al., ICRA 2023), its authors' program, a library that uses the same value,
a measurement, or a choice, with the data used. [Thresholds](decisions.md) has the numbers.
"""
USERS = """
## Settings for most users

| setting | default | unit | allowed | meaning |
|---|---|---|---|---|
"""
EXPERTS = """
## All settings, for experts
"""
SOURCE = re.compile(r" \[([^\]]+)\]$")
SIGNS: dict[type, tuple[str, str]] = {
    **{Ge: ("at least", "ge"), Gt: ("above", "gt"), Le: ("at most", "le"), Lt: ("below", "lt")},
    MinLen: ("length at least", "min_length"),
}
TRAILING_UNITS = re.compile(r" \((m|s|degrees|m\^2|m per m)\)$")


def page() -> str:
    """The page's text."""
    default = Config()
    users = ""
    for setting in USER_SETTINGS:
        name, key = setting.split(".")
        section = getattr(default, name)
        users += _row(setting, section.model_dump(mode="json")[key], type(section).model_fields[key])
    sections = "".join(_section(name, getattr(default, name)) for name in Config.model_fields)
    return INTRODUCTION + USERS + users + EXPERTS + sections


def _section(name: str, section: Section) -> str:
    values = section.model_dump(mode="json")
    rows = [_row(key, values[key], field, source=True) for key, field in type(section).model_fields.items()]
    about = f"{type(section).__doc__}\n\n" if type(section).__doc__ != Section.__doc__ and type(section).__doc__ else ""
    head = "| setting | default | unit | allowed | meaning | source |\n|---|---|---|---|---|---|\n"
    return f"\n### {name}\n\n{about}{head}{''.join(rows)}"


def _row(key: str, value: Any, field: FieldInfo, *, source: bool = False) -> str:
    description = " ".join((field.description or "").split())
    found = SOURCE.search(description)
    meaning = SOURCE.sub("", description)
    unit = TRAILING_UNITS.search(meaning)
    cells = (
        f"`{key}`",
        f"`{_shown(value)}`",
        unit[1] if unit else "",
        _allowed(field),
        TRAILING_UNITS.sub("", meaning).replace("|", "\\|"),
        *([found[1] if found else ""] if source else []),
    )
    return f"| {' | '.join(cells)} |\n"


def _shown(value: Any) -> str:
    """As YAML writes it in one line."""
    return yaml.safe_dump(value, default_flow_style=True, width=1000).strip().removesuffix("\n...")


def _allowed(field: FieldInfo) -> str:
    if choices := _choices(field.annotation):
        return ", ".join(f"`{_shown(choice)}`" for choice in choices)
    signs = [(*SIGNS[type(limit)], limit) for limit in field.metadata if type(limit) in SIGNS]
    return ", ".join(f"{words} {getattr(limit, name):g}" for words, name, limit in signs)


def _choices(hint: Any) -> tuple[object, ...]:
    if get_origin(hint) is Literal:
        return get_args(hint)
    if get_origin(hint) in (Union, UnionType):
        return tuple(choice for part in get_args(hint) for choice in _choices(part))
    return (True, False) if hint is bool else ()


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
