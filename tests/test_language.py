"""Plain English: docstrings, comments, messages, pages and function names avoid the project's former private words."""

import io
import re
import tokenize
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PRIVATE = re.compile(
    r"\b(robbed|voices?|told|says|worth|believe[ds]?|mends?|mended|alike|anew|doubt(ed|s)?|nobody|somebody"
    r"|turned back|what is kept|(is|are|was) asked|goes on|a word|left over|leftover)\b",
    re.IGNORECASE,
)
"""Say instead: weight, inlier, outlier, detect, report, contain, correct, equal, again, continue, instead of."""
NAMES = {"doubts", "_nobody"}
"""Code may use these as names; text may quote them in backquotes."""
CODE = sorted(
    file
    for part in ("segslam", "tools", "tests", "docs")
    for file in (ROOT / part).rglob("*.py")
    if file != Path(__file__)
)
TEXTS = ROOT / "segslam" / "output" / "words.toml"
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", TEXTS, *sorted((ROOT / "docs").glob("*.md"))]


def _texts(file: Path) -> list[tuple[int, str]]:
    """(line number, text) of every line of comments and strings, and of names with several words."""
    source = file.read_text(encoding="utf-8")
    kinds = {tokenize.COMMENT, tokenize.STRING, getattr(tokenize, "FSTRING_MIDDLE", -1)}
    found = []
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.string.strip("\"'") in NAMES:
            continue
        if token.type in kinds:
            found += [(token.start[0] + k, line) for k, line in enumerate(token.string.splitlines())]
        elif token.type == tokenize.NAME and "_" in token.string:
            found.append((token.start[0], token.string.replace("_", " ")))
    return found


def _private(lines: list[tuple[int, str]]) -> list[str]:
    return [
        f"{number}: {text.strip()}" for number, text in lines if PRIVATE.search(re.sub(r"`[^`]*`|\{[^}]*\}", "", text))
    ]


@pytest.mark.parametrize("file", CODE, ids=lambda file: str(file.relative_to(ROOT)))
def test_code_speaks_plain_english(file: Path) -> None:
    assert not _private(_texts(file))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_pages_speak_plain_english(page: Path) -> None:
    assert not _private(list(enumerate(page.read_text(encoding="utf-8").splitlines(), 1)))
