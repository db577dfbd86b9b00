"""An index of places: signatures of keyframes, and search for those most similar to the signature of a scan."""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8
from scipy.fft import irfft, rfft

from segslam.candidates.signature import NUM_ANGLES, NUM_RADII, PlaceSignature
from segslam.core.trajectory import Rows
from segslam.core.types import Indices, Vector

NUM_HARMONICS = 12
"""Chosen on the real places of KITTI 05: number of harmonics of each circle; their magnitudes are invariant to yaw."""
NUM_TURNED = 40
"""Chosen: number of the most similar places that are compared at every yaw."""
SAME_PLACE_M = 4.0
"""Chosen: scans taken nearer to each other than this show the same: one of them is tried."""
OTHER_PLACE_M = 10.0
"""Chosen: scans taken farther from each other than this show different places."""


@dataclass(frozen=True, slots=True)
class PlaceCandidate:
    """A place at which a scan may have been taken."""

    place_id: int
    score: float
    """Correlation of the two spectra at the best yaw, at most 1."""
    yaw_rad: float
    """Yaw of the scan in the frame of the place, 0 to pi; the yaw plus pi is equally likely."""


class Places:
    """Signatures of places, 2.6 kB each: the spectra and their magnitudes, which are searched."""

    def __init__(self) -> None:
        self._ids = Rows(np.empty(0, np.int64))
        self._spectra = Rows(np.empty((0, NUM_RADII, NUM_ANGLES), np.uint8))
        self._invariants = Rows(np.empty((0, NUM_RADII * NUM_HARMONICS), np.float32))

    def __len__(self) -> int:
        return len(self._ids)

    @property
    def bytes_per_place(self) -> int:
        """Memory per place in bytes."""
        return sum(rows.all()[:1].nbytes for rows in (self._ids, self._spectra, self._invariants))

    def add(self, place_id: int, signature: PlaceSignature) -> None:
        """Add a place. Ids may come in any order, each once."""
        self._ids.append(place_id)
        self._spectra.append(signature.spectrum)
        self._invariants.append(_invariant(signature))

    def shortlist(
        self, signature: PlaceSignature, *, most: int = 20, below_id: int | None = None
    ) -> tuple[PlaceCandidate, ...]:
        """The places most similar to a scan, best first; only ids below `below_id`, if given."""
        ids = self._ids.all()
        rows = np.arange(len(ids)) if below_id is None else np.flatnonzero(ids < below_id)
        if not len(rows):
            return ()
        similarity = np.einsum("ij,j->i", self._invariants.all(), _invariant(signature))  # uses one thread
        kept = rows[np.argsort(-similarity[rows], kind="stable")[: max(NUM_TURNED, most)]]
        scores, yaws = self._turned(signature, kept)
        best = np.argsort(-scores, kind="stable")[:most]
        return tuple(PlaceCandidate(int(ids[kept[k]]), float(scores[k]), float(yaws[k])) for k in best)

    def shortlist_around(
        self, signatures: Iterable[PlaceSignature], *, most: int = 20, below_id: int | None = None
    ) -> tuple[PlaceCandidate, ...]:
        """The same for several signatures of one scan (`signatures_around`): the best candidate of each place."""
        found = [one for signature in signatures for one in self.shortlist(signature, most=most, below_id=below_id)]
        best: dict[int, PlaceCandidate] = {}
        for candidate in sorted(found, key=lambda candidate: -candidate.score):
            best.setdefault(candidate.place_id, candidate)
        return tuple(best.values())[:most]

    def _turned(self, signature: PlaceSignature, rows: Indices) -> tuple[Vector, Vector]:
        """Largest correlation of the spectra of some places with the scan's, over all yaws, and the yaws."""
        own, theirs = (
            rfft(_centred(signature.spectrum[None]), axis=2),
            rfft(_centred(self._spectra.all()[rows]), axis=2),
        )
        correlation = irfft((theirs * np.conj(own)).sum(axis=1), NUM_ANGLES, axis=1)
        return correlation.max(axis=1), -correlation.argmax(axis=1) % NUM_ANGLES * math.pi / NUM_ANGLES


def _centred(spectra: UInt8[np.ndarray, "n 24 60"]) -> Float[np.ndarray, "n 24 60"]:
    """The spectra without the mean of each circle, scaled to unit length."""
    values = spectra.astype(np.float32)
    values -= values.mean(axis=2, keepdims=True)
    return values / np.maximum(np.linalg.norm(values, axis=(1, 2), keepdims=True), 1e-9)


def _invariant(signature: PlaceSignature) -> Float[np.ndarray, "288"]:
    """Square roots of the magnitudes of the harmonics of each circle, scaled to unit length."""
    harmonics = np.sqrt(np.abs(rfft(signature.spectrum.astype(np.float32), axis=1)[:, :NUM_HARMONICS])).ravel()
    return harmonics / max(float(np.linalg.norm(harmonics)), 1e-9)
