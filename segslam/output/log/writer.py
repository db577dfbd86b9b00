"""Writes the steps of a run to an MCAP file that is readable up to its last complete step at any time."""

import fcntl
import json
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from types import MappingProxyType
from typing import IO, Any, cast

from google.protobuf.message import Message
from mcap.writer import CompressionType, Writer

from segslam.core.config import Config
from segslam.core.interrupts import interrupts_wait
from segslam.core.memory import status_mb
from segslam.core.types import (
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
    WorkFailed,
)
from segslam.output.log import foxglove, schema
from segslam.output.log.container import message_within
from segslam.output.log.drawing import Drawing, ground_truth, map_message, map_points, words
from segslam.output.log.records import KeyframePoints, codec, keyframe_points, points_and_labels
from segslam.output.log.schema import channels, metadata
from segslam.slam.adjustment.rounds import Adjusted

POSES_PER_KEYFRAME = 50
"""Chosen: number of logged poses of estimates per keyframe, about 4 kB each, so that the log grows with the drive
only. All estimates are logged until the limit is reached; then every second estimate, and so on."""
CHUNK_BYTES = 4 * 2**20
"""Larger than any step: a chunk ends with its step, so that a step is complete or missing."""
Unwritten = tuple[str, bytes | Message]
"""Topic and content of a message, which may not be serialised yet."""
Mirror = Callable[[str, bytes, int], None]
"""Called with topic, data and stamp (ns) of each message after it is written."""


class Output:
    """The stream of MCAP's writer: nothing is pending after a failure, and no other process can write the file."""

    def __init__(self, path: Path, *, replaces: bool = False) -> None:
        """Raises OSError if it cannot be written, another process writes it, or, without `replaces`, it exists."""
        self.raw = path.open("a+b" if replaces else "x+b", buffering=0)
        fcntl.flock(self.raw, fcntl.LOCK_EX | fcntl.LOCK_NB)
        self.raw.truncate(0)
        self.raw.seek(0)
        self.tell = self.raw.tell
        self.close = self.raw.close

    def write(self, data: bytes) -> int:
        """Write all data; a single write to a raw file may be partial."""
        rest = memoryview(data)
        while rest:
            rest = rest[self.raw.write(rest) :]
        return len(data)

    def flush(self) -> None:
        """No effect: the stream is unbuffered."""


def is_being_written(path: Path) -> bool:
    """True if any process has an `Output` open on the file."""
    with path.open("rb") as stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
        return False


class LogWriter:
    """Writes the steps of a run as they come; a context manager.

    Each step is passed to the operating system as one compressed chunk with a checksum before `write` returns: a slow
    disk delays the run, and memory does not grow. A full or failing disk raises WorkFailed and leaves a file that ends
    with the last complete step. Ctrl-C takes effect after a step is complete.
    """

    def __init__(
        self,
        path: Path,
        *,
        config: Config,
        dataset: str = "",
        T_camera_lidar: Transform | None = None,
        reference: Trajectory | None = None,
        options: Mapping[str, str] = MappingProxyType({}),
        mirror: Mirror | None = None,
        replaces: bool = False,
    ) -> None:
        """Raises FileExistsError if there is a file, unless `replaces` is set; SegslamError if it cannot be written.

        `reference`: true poses; `T_camera_lidar`: calibration of KITTI data. A replay has no other source for both.

        `options` are options beside the settings, which must be the same when the run is resumed.
        `mirror` is called with each message that is written.
        """
        self._mirror = mirror
        self._path = path
        self._drawing = Drawing()
        self._resolution_m = config.keyframes.resolution_m
        self._stamp_ns = 0
        self._num_poses = 0
        self._newest: Keyframe | None = None
        self._is_ended = False
        self._steps_of_keyframes: dict[int, tuple[int, int]] = {}
        """Position in the file, and size, of the step of each keyframe."""
        try:
            self._output = Output(path, replaces=replaces)
        except FileExistsError:
            raise
        except OSError as error:
            raise SegslamError(f"{path}: cannot write the log ({error.strerror}); give another folder") from error
        self._mcap = Writer(cast(IO[bytes], self._output), chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
        with self._whole():
            self._mcap.start(library=f"segslam {version('segslam')}")
            for name, data in metadata(config, dataset, T_camera_lidar, options).items():
                self._mcap.add_metadata(name, data)
            self._channels = _register_channels(self._mcap)
        if reference is not None and len(reference):
            first_ns = int(reference.stamp_ns[0])
            given = schema.REFERENCE, _json(reference)
            self._write([ground_truth(reference, stamp_ns=first_ns), given], stamp_ns=first_ns)

    def write(self, step: Step) -> None:
        """Add a step."""
        written = self._write(self._step_messages(step), stamp_ns=step.stamp_ns)
        if step.keyframe is not None:
            self._steps_of_keyframes[step.keyframe.id] = written

    def warn(self, text: str) -> None:
        """Add a warning to `/log`, at the time of the last step."""
        self._write([words(text, stamp_ns=self._stamp_ns)], stamp_ns=self._stamp_ns)

    def keep(self, keyframe: Keyframe) -> None:
        """Keep the newest keyframe in memory until its step is written: `Clouds` of segslam.keyframes."""
        self._newest = keyframe

    def cloud(self, keyframe_id: int) -> tuple[Points, Labels]:
        """Points and labels of a keyframe, in any thread. Raises SegslamError if the log is closed."""
        newest = self._newest
        if newest is not None and newest.id == keyframe_id:
            return newest.points, newest.labels
        offset, size = self._steps_of_keyframes[keyframe_id]
        name = f"{self._path}: keyframe {keyframe_id}"
        try:
            records = os.pread(self._output.raw.fileno(), size, offset)
        except (OSError, ValueError) as error:  # ValueError: closed, perhaps just now
            raise SegslamError(f"{name} cannot be read, the log is closed") from error
        data = message_within(records, self._channels[schema.KEYFRAME])
        if data is None:
            raise SegslamError(f"{name} is missing; the log was changed while it was open")
        return points_and_labels(KeyframePoints.FromString(data))

    def write_result(
        self,
        estimate: GraphEstimate,
        trajectory: Trajectory,
        late_loops: tuple[LoopAttempt, ...] = (),
        adjusted: Adjusted | None = None,
    ) -> None:
        """Write the final estimate, the pose of every scan, loops tried after the last scan, and the adjustment."""
        stamp_ns = self._stamp_ns
        points, labels = map_points(estimate.T_world_keyframe, self.cloud)
        messages: list[Unwritten] = [map_message(points, labels, stamp_ns=stamp_ns)] if len(points) else []
        messages += [*self._drawing.draw_estimate(estimate, stamp_ns=stamp_ns), _estimate_message(estimate)]
        if late_loops:
            messages.append((schema.LATE_LOOPS, _json(LateLoops(late_loops))))
        if adjusted is not None:
            before = foxglove.path(adjusted.before.T_world_keyframe.values(), stamp_ns=stamp_ns)
            messages += [(schema.TRAJECTORY_BEFORE, before), (schema.ADJUSTMENT, _json(adjusted.record))]
        self._write([*messages, (schema.RESULT, _json(trajectory))], stamp_ns=stamp_ns)

    def move(self, path: Path) -> None:
        """Replace the file `path`, after all data written here is safely on the disk.

        Raises SegslamError if another process writes the file, WorkFailed if it cannot be replaced.
        """
        try:
            os.fsync(self._output.raw.fileno())
            if path.exists() and is_being_written(path):
                raise SegslamError(f"{path}: another process writes it; wait for its end")
            self._path.replace(path)
        except OSError as error:
            raise WorkFailed(f"{path}: cannot be replaced by {self._path} ({error.strerror})") from error
        self._path = path

    def end(self) -> None:
        """Write the index, once. The log is whole then, but counts as being written until `close`."""
        if not self._is_ended:
            self._is_ended = True
            with self._whole():
                self._mcap.finish()

    def close(self) -> None:
        """Write the index, and close the file. A log without index is readable, but slower to search."""
        if not self._output.raw.closed:
            try:
                self.end()
            finally:
                self._output.close()

    def __enter__(self) -> "LogWriter":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _step_messages(self, step: Step) -> Iterator[Unwritten]:
        """The messages of a step. The step itself is last: it marks the others as complete."""
        logs_estimate = step.estimate is not None and self._affords(len(step.estimate.T_world_keyframe))
        yield from self._drawing.draw(step, path=logs_estimate)
        if (rss_mb := status_mb("VmRSS")) is not None:
            yield schema.MEMORY, json.dumps({"rss_mb": round(rss_mb, 1)}).encode()
        if step.keyframe is not None:
            yield schema.KEYFRAME, keyframe_points(step.keyframe, resolution_m=self._resolution_m)
        if step.estimate is not None and logs_estimate:
            yield _estimate_message(step.estimate)
        yield schema.STEP, _json(step)

    def _affords(self, num_poses: int) -> bool:
        """True if the logged estimates may contain this many more poses; counts them if so."""
        if self._num_poses + num_poses > POSES_PER_KEYFRAME * num_poses:
            return False
        self._num_poses += num_poses
        return True

    def _write(self, messages: Iterable[Unwritten], *, stamp_ns: int) -> tuple[int, int]:
        """Position in the file, and size."""
        if stamp_ns < 0:
            raise SegslamError(f"{self._path}: stamp {stamp_ns} ns is negative; shift the stamps of the scans")
        encoded = [  # before writing: an encoding error must not leave half a step
            (topic, content if isinstance(content, bytes) else content.SerializeToString())
            for topic, content in messages
        ]
        self._stamp_ns = stamp_ns
        with self._whole():
            offset = self._output.tell()
            for topic, data in encoded:
                self._mcap.add_message(self._channels[topic], stamp_ns, data, stamp_ns)
            self._mcap.flush()
            written = offset, self._output.tell() - offset
        if self._mirror is not None:
            for topic, data in encoded:
                self._mirror(topic, data, stamp_ns)
        return written

    @contextmanager
    def _whole(self) -> Iterator[None]:
        """Context manager that writes its data completely or not at all. Ctrl-C takes effect at its end.

        On any exception the file is truncated to its previous size and closed; that of a full disk becomes WorkFailed.
        """
        raw = self._output.raw
        if raw.closed:
            raise SegslamError(f"{self._path}: the log is closed; open another log to write more")
        size = raw.tell()
        try:
            with interrupts_wait():
                try:
                    yield
                except BaseException:
                    raw.truncate(size)
                    raw.close()
                    raise
        except OSError as error:
            raise WorkFailed(
                f"{self._path}: cannot continue writing the log ({error.strerror}); free space on the disk; "
                "the log ends with the last complete step"
            ) from error


def _register_channels(mcap: Writer) -> dict[str, int]:
    """Channel by topic; all topics and their schemas are written at the start of the file."""
    schema_ids: dict[str, int] = {}
    found: dict[str, int] = {}
    for topic, encoding, name, schema_encoding, description in channels():
        if name not in schema_ids:
            schema_ids[name] = mcap.register_schema(name, schema_encoding, description)
        found[topic] = mcap.register_channel(topic, encoding, schema_ids[name])
    return found


def _estimate_message(estimate: GraphEstimate) -> Unwritten:
    return schema.ESTIMATE, _json(estimate, keyframe_ids=list(estimate.T_world_keyframe))


def _json(record: Any, **more: Any) -> bytes:
    return json.dumps(codec(record.__class__).encode(record) | more, allow_nan=False).encode()
