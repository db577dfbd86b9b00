"""Reads the steps of a run from an MCAP log, up to the end of its complete part."""

import json
import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeVar

import numpy as np
from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame
from google.protobuf.message import DecodeError

from segslam.core.config import Config, config_from_yaml
from segslam.core.errors import brief, unreadable
from segslam.core.types import (
    CloudOf,
    GraphEstimate,
    Keyframe,
    Labels,
    LateLoops,
    LoopAttempt,
    Points,
    SegslamError,
    Step,
    Trajectory,
    Transform,
)
from segslam.output.folder import log_of
from segslam.output.log import container, schema
from segslam.output.log.container import CutError, message_within
from segslam.output.log.foxglove import transforms
from segslam.output.log.records import Bulk, KeyframePoints, codec, intensities, points_and_labels
from segslam.output.log.schema import restored
from segslam.slam.adjustment.rounds import Adjustment

logger = logging.getLogger(__name__)
NOT_OURS = (LookupError, ValueError, TypeError, AttributeError, OverflowError, RecursionError, DecodeError)
"""Exceptions on content of another program, or damaged in spite of a correct checksum."""
Parts = dict[str, container.Stored]
"""The latest message of each topic."""
Decoded = TypeVar("Decoded")


@dataclass(frozen=True, slots=True)
class RunLog:
    """An open log: metadata of the run, and access to its steps."""

    path: Path
    config: Config
    """The effective settings of the run."""
    run: Mapping[str, str]
    """schema_version, dataset, python, platform, and T_camera_lidar (JSON) if known."""
    packages: Mapping[str, str]
    """Package -> version."""
    options: Mapping[str, str]
    """Options beside the settings, such as the source of the labels."""

    @property
    def T_camera_lidar(self) -> Transform | None:  # noqa: N802  (a transform)
        """Calibration of KITTI data; None for other data."""
        if "T_camera_lidar" not in self.run:
            return None
        return self._decoded(lambda: np.array(json.loads(self.run["T_camera_lidar"]), np.float64).reshape(4, 4))

    def num_steps(self) -> int:
        """Number of complete steps in the log."""
        return container.count(self.path, schema.STEP)

    def steps(self, *, clouds: bool = True) -> Iterator[Step]:
        """The steps in order, read when they are requested.

        Without `clouds`, keyframes have no points, and reading takes a quarter of the time.
        A truncated or damaged log yields its complete steps and logs a warning with their number.
        Raises SegslamError if the content is not in the format of this version.
        """
        num_steps = 0
        try:
            for parts in self._parts_until(schema.STEP):
                yield self._decoded(_step, parts, clouds)
                num_steps += 1
        except CutError as cut:
            size = self.path.stat().st_size
            logger.warning(
                "%s: cut or damaged at byte %d of %d: kept the first %d steps", self.path, cut.offset, size, num_steps
            )

    def whole_steps(self, num_keyframes: int) -> Iterator[Step]:
        """As `steps`; the loops tried after the last scan belong to the step of the last of so many keyframes."""
        late = self.late_loops()
        for step in self.steps():
            is_last = step.keyframe is not None and step.keyframe.id == num_keyframes - 1
            yield replace(step, attempts=(*step.attempts, *late)) if is_last else step

    def reference(self) -> Trajectory | None:
        """The true poses of the scans, if known."""
        with suppress(CutError):
            for message in self._messages():
                if message.topic == schema.REFERENCE:
                    return self._decoded(_record, Trajectory, message)
                if message.topic == schema.STEP:
                    return None
        return None

    def result(self) -> tuple[GraphEstimate, Trajectory] | None:
        """The last estimate and the pose of every scan; None if the run did not finish."""
        parts = self._ending()
        if not parts:
            return None
        return self._decoded(_estimate, parts), self._decoded(_record, Trajectory, parts[schema.RESULT])

    def final(self) -> tuple[GraphEstimate, Trajectory]:
        """As `result`. Raises SegslamError if the run did not finish."""
        if (result := self.result()) is None:
            raise SegslamError(f"{self.path}: the run did not finish; continue it (segslam resume), or replay its log")
        return result

    def late_loops(self) -> tuple[LoopAttempt, ...]:
        """Loops tried after the last scan; empty if the run did not finish."""
        late = self._ending().get(schema.LATE_LOOPS)
        return () if late is None else self._decoded(_record, LateLoops, late).attempts

    def adjustment(self) -> Adjustment | None:
        """The adjustment of the whole map; None without one, or if the run did not finish."""
        made = self._ending().get(schema.ADJUSTMENT)
        return None if made is None else self._decoded(_record, Adjustment, made)

    def _ending(self) -> Parts:
        """The messages of the result; empty if the run did not finish."""
        with suppress(CutError):
            for parts in self._parts_until(schema.RESULT, since_last=schema.TRAJECTORY):
                return parts
        return {}

    def keyframes(self) -> tuple[list[Keyframe], CloudOf]:
        """The keyframes of the complete steps, without points, and a function that reads the points of each.

        Raises SegslamError as `steps` does; the function, if the file has changed since.
        """
        keyframes: list[Keyframe] = []
        places: list[tuple[tuple[int, int], int]] = []
        with suppress(CutError):
            for parts in self._parts_until(schema.STEP):
                if (stored := parts.get(schema.KEYFRAME)) is None:
                    continue
                parts.pop(schema.ESTIMATE, None)
                keyframe = self._decoded(_step, parts, False).keyframe
                if keyframe is None or keyframe.id != len(keyframes):
                    raise SegslamError(f"{self.path}: keyframe {len(keyframes)} is missing; map the data again")
                keyframes.append(keyframe)
                places.append((stored.chunk, stored.channel_id))
        return keyframes, partial(self._cloud, places)

    def _cloud(self, places: Sequence[tuple[tuple[int, int], int]], keyframe_id: int) -> tuple[Points, Labels]:
        """The points of a keyframe; `places`: offset and size of the chunk with those of each, and their channel."""
        (offset, size), channel_id = places[keyframe_id]
        try:
            with self.path.open("rb") as stream:
                stream.seek(offset)
                data = message_within(stream.read(size), channel_id)
            if data is not None:
                return points_and_labels(KeyframePoints.FromString(data))
        except (OSError, ValueError, DecodeError) as error:
            raise SegslamError(f"{self.path}: keyframe {keyframe_id} cannot be read ({error})") from error
        raise SegslamError(f"{self.path}: keyframe {keyframe_id} is missing; the log was changed while it was open")

    def _parts_until(self, last: str, *, since_last: str | None = None) -> Iterator[Parts]:
        """The messages of each step, or of other groups that end with the topic `last`. Raises CutError at a cut."""
        parts: Parts = {}
        for message in self._messages(since_last=since_last):
            parts[message.topic] = message
            if message.topic == last:
                yield parts
                parts = {}

    def _messages(self, *, since_last: str | None = None) -> Iterator[container.Stored]:
        """As `container.messages`. Raises CutError, and SegslamError if the records are not those of this version."""
        own = schema.json_schemas()
        for message in container.messages(self.path, since_last=since_last):
            if message.topic in own and not _is_readable(message.schema.data, own.pop(message.topic)):
                raise SegslamError(
                    f"{self.path}: its {message.schema.name} has another format than this version reads; "
                    f"use segslam {self.packages.get('segslam', 'of that time')}, which wrote it"
                )
            yield message

    def _decoded(self, decode: Callable[..., Decoded], *given: Any) -> Decoded:
        try:
            return decode(*given)
        except NOT_OURS as error:
            raise SegslamError(
                f"{self.path}: not written by segslam ({brief(repr(error))}); map the data again"
            ) from error


def read_log(run: Path) -> RunLog:
    """The log of a run, complete or not, given it or its folder. Raises SegslamError if it is missing or unreadable."""
    path = log_of(run)
    remedy = "give the log.mcap of a run"
    try:
        metadata, cut = container.metadata(path)
    except OSError as error:
        raise SegslamError(f"{unreadable(path, 'log', error)}; {remedy}") from error
    check = metadata.get(schema.CHECK_METADATA)
    if cut is not None and check is None:
        raise SegslamError(f"{path}: not a log of segslam, or truncated at its start; {remedy}, or map again") from cut
    if check is not None and check.get("crc32") != str(schema.checksum(metadata)):
        raise SegslamError(f"{path}: the settings at its start are damaged (wrong checksum); map the data again")
    about = restored(metadata.get(schema.RUN_METADATA, {}))
    if "yaml" not in metadata.get(schema.CONFIG_METADATA, {}) or "schema_version" not in about:
        raise SegslamError(f"{path}: an MCAP file, but not a log of segslam; {remedy}")
    packages = metadata.get(schema.PACKAGES_METADATA, {})
    if about["schema_version"] != str(schema.VERSION):
        raise SegslamError(
            f"{path}: a log of schema version {brief(about['schema_version'])}, but this version reads "
            f"{schema.VERSION}; use segslam {brief(packages.get('segslam', 'of that time'))}, which wrote it"
        )
    config = config_from_yaml(metadata[schema.CONFIG_METADATA]["yaml"], f"{path} (settings)")
    options = restored(metadata.get(schema.OPTIONS_METADATA, {}))
    return RunLog(path=path, config=config, run=about, packages=packages, options=options)


def _is_readable(written: bytes, own: dict[str, Any]) -> bool:
    try:
        return schema.is_readable(json.loads(written), own)
    except (ValueError, AttributeError, TypeError, RecursionError):
        return False


def _step(parts: Parts, clouds: bool) -> Step:
    """The step; without `clouds`, its keyframe has no points."""
    keyframe: dict = {}
    if schema.KEYFRAME in parts:
        message = KeyframePoints.FromString(parts[schema.KEYFRAME].data)
        points, labels = points_and_labels(message if clouds else KeyframePoints())
        known = intensities(message) if clouds else None
        keyframe = {"points": points, "labels": labels, "intensities": known, "place": message.place or None}
    estimate = _estimate(parts) if schema.ESTIMATE in parts else None
    return _record(Step, parts[schema.STEP], {Step: {"estimate": estimate}, Keyframe: keyframe})


def _estimate(parts: Parts) -> GraphEstimate:
    """The estimate from an /estimate message and the /trajectory before it."""
    values = json.loads(parts[schema.ESTIMATE].data)
    poses = transforms(PosesInFrame.FromString(parts[schema.TRAJECTORY].data))
    T_world_keyframe = dict(zip(values["keyframe_ids"], poses, strict=True))
    return codec(GraphEstimate).decode(values, {GraphEstimate: {"T_world_keyframe": T_world_keyframe}})


def _record(record: Callable[..., Decoded], message: container.Stored, bulk: Bulk = MappingProxyType({})) -> Decoded:
    return codec(record).decode(json.loads(message.data), bulk)
