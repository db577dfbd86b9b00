"""The documentation site: python -m sphinx -W docs site"""

import sys
from pathlib import Path

DOCS = Path(__file__).parent
sys.path.insert(0, str(DOCS.parent / "tools"))

import reference_pages  # noqa: E402  (beside the other tools)

reference_pages.write(DOCS)
project = "segslam"
author = "the authors of segslam"
extensions = ["myst_parser", "sphinx.ext.autodoc"]
html_theme = "furo"
html_title = "segslam"
exclude_patterns = ["examples"]
myst_heading_anchors = 3
suppress_warnings = ["myst.xref_missing"]  # links to programs and notebooks, which test_docs.py checks
smartquotes = False  # two dashes begin an option
autodoc_typehints = "none"
autodoc_member_order = "bysource"
