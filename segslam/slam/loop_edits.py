"""A person's word on loops: pairs of keyframes that are never closed, and pairs that are registered in any case."""

import json
from collections.abc import Iterable
from dataclasses import dataclass

from segslam.core.errors import SegslamError, brief

Pair = tuple[int, int]
"""Ids of two keyframes, the newer first."""


@dataclass(frozen=True, slots=True)
class LoopEdits:
    """Pairs of keyframes whose loop is forbidden, and pairs whose loop is tried without an initial guess."""

    forbidden: frozenset[Pair] = frozenset()
    added: frozenset[Pair] = frozenset()

    def __post_init__(self) -> None:
        """Raises SegslamError for a pair that is both, or not a newer and an older keyframe."""
        for newer, older in sorted(self.forbidden & self.added):
            raise SegslamError(f"{newer}:{older}: both forbidden and added; give one of the two")
        for newer, older in sorted(self.forbidden | self.added):
            if not 0 <= older < newer:
                raise SegslamError(f"{newer}:{older}: give two keyframes of loops.csv, the newer first: 120:15")

    def and_then(self, later: "LoopEdits") -> "LoopEdits":
        """These edits followed by others, which win where the two contradict."""
        return LoopEdits((self.forbidden - later.added) | later.forbidden, (self.added - later.forbidden) | later.added)

    def shifted(self, by: int) -> "LoopEdits":
        """The same where the ids of all keyframes are larger by this number."""
        return LoopEdits(*(frozenset((a + by, b + by) for a, b in pairs) for pairs in (self.forbidden, self.added)))

    def to_json(self) -> str:
        """Text for the options of a log."""
        return json.dumps({"forbidden": sorted(self.forbidden), "added": sorted(self.added)})

    @classmethod
    def from_json(cls, text: str) -> "LoopEdits":
        """The edits of a text by `to_json`; none for an empty text. Raises SegslamError for another text."""
        if not text:
            return cls()
        try:
            content = json.loads(text)
            return cls(*(frozenset((int(a), int(b)) for a, b in content[key]) for key in ("forbidden", "added")))
        except (ValueError, TypeError, KeyError) as error:
            raise SegslamError(f"edits of the log: {brief(text)} cannot be read; map the data again") from error


NO_EDITS = LoopEdits()


def pairs_of(texts: Iterable[str], option: str) -> frozenset[Pair]:
    """The pairs of texts `I:J`, in either order. Raises SegslamError, naming the option, for another form."""
    pairs = set()
    for text in texts:
        first, _, second = text.partition(":")
        if not (first.isdecimal() and second.isdecimal()):
            raise SegslamError(f"{option} {brief(text)}: give two keyframes of loops.csv, as in {option} 120:15")
        pairs.add((max(int(first), int(second)), min(int(first), int(second))))
    return frozenset(pairs)
