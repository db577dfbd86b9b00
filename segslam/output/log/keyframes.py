"""The keyframes of a log: everything except their points in memory; points are read from the file when used."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from google.protobuf.message import DecodeError

from segslam.core.types import Keyframe, Labels, Points, SegslamError
from segslam.output.log.cloud import KeyframePoints, points_and_labels
from segslam.output.log.container import CutError, Span, messages_within


@dataclass(frozen=True, slots=True, eq=False)
class RecordedKeyframe:
    """A keyframe without its points, and their position in the file."""

    keyframe: Keyframe
    chunk: Span
    channel_id: int


class RecordedKeyframes:
    """Keyframes by id; the `segslam.keyframes.Clouds` of a finished run."""

    def __init__(self, path: Path, kept: Sequence[RecordedKeyframe]) -> None:
        self._path = path
        self._kept = {one.keyframe.id: one for one in kept}

    def __len__(self) -> int:
        return len(self._kept)

    def __getitem__(self, keyframe_id: int) -> Keyframe:
        """A keyframe, without points."""
        return self._kept[keyframe_id].keyframe

    def keep(self, keyframe: Keyframe) -> None:
        """Raises TypeError: keyframes cannot be added to a recorded drive."""
        raise TypeError(f"keyframe {keyframe.id}: the log {self._path} is read only")

    def cloud(self, keyframe_id: int) -> tuple[Points, Labels]:
        """Points and labels of a keyframe. Raises SegslamError if the file has changed since it was opened."""
        one = self._kept[keyframe_id]
        try:
            with self._path.open("rb") as stream:
                stream.seek(one.chunk.offset)
                records = stream.read(one.chunk.size)
            for channel_id, data in messages_within(records):
                if channel_id == one.channel_id:
                    return points_and_labels(KeyframePoints.FromString(data))
        except (OSError, CutError, ValueError, DecodeError) as error:
            raise SegslamError(f"{self._path}: keyframe {keyframe_id} cannot be read ({error})") from error
        raise SegslamError(f"{self._path}: keyframe {keyframe_id} is missing; the log was changed while it was open")
