"""Texts about a run that people read, from words.toml; docs/glossary.md is written from here."""

import tomllib
from importlib import resources

_TEXTS: dict[str, dict[str, str]] = tomllib.loads(
    resources.files("segslam.output").joinpath("words.toml").read_text(encoding="utf-8")
)
FIGURES = _TEXTS["figures"]
"""Meaning of the figures of `metrics.json`, the most important first."""
SCORES = _TEXTS["scores"]
"""Meaning of the figures that only the evaluation has."""
WORDS = _TEXTS["words"]
"""What the words of a report and of `loops.csv` mean, in the order of the pipeline."""
REASONS = _TEXTS["reasons"]
"""`RejectReason` -> why the candidate was rejected, in the order of the pipeline."""
COLUMNS = _TEXTS["columns"]
"""Figures -> heads of the columns of a table for people."""
CONDITIONS = _TEXTS["conditions"]
"""Key in the log -> text in the report."""
FILES = _TEXTS["files"]
"""Files of a run folder -> what they contain, in HTML."""
