"""The documentation site: python -m sphinx -W docs site"""

import re
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
maximum_signature_line_length = 70  # otherwise one parameter a line
NUMPY_INPUT = re.compile(r"_Buffer \| _SupportsArray.*?_NestedSequence\[complex \| bytes \| str\]")
DEFAULT_OBJECT = re.compile(r"<(?:function|class|object).*?>(?=[,)])|mappingproxy\({}\)")
MODULE_PATH = re.compile(r"~?\b(?:\w+\.)+(?=[A-Z_])")


def _short(_app, _what, _name, _target, _options, signature, returns):
    """Types as a reader needs them: `ArrayLike` instead of numpy's own union, shapes as in the code."""

    def shortened(text):
        for pattern, short in ((DEFAULT_OBJECT, "..."), (MODULE_PATH, ""), (NUMPY_INPUT, "ArrayLike")):
            text = pattern.sub(short, text)
        return text.replace("~", "")

    return tuple(text and shortened(text) for text in (signature, returns))


def setup(app):
    app.connect("autodoc-process-signature", _short)


autodoc_member_order = "bysource"
