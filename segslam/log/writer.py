"""Steps into an MCAP file that can be read up to its last complete step at any moment."""

import json
import platform
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from types import TracebackType
from typing import IO, Any, cast

from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from mcap.writer import CompressionType, Writer
from mcap_protobuf.schema import register_schema

from segslam.config import Config, config_to_yaml
from segslam.log import schema
from segslam.log.cloud import KeyframePoints, keyframe_points
from segslam.log.drawing import Drawing, ground_truth
from segslam.log.records import codec
from segslam.types import GraphEstimate, Keyframe, SegslamError, Step, Trajectory, Transform

PACKAGES = ("segslam", "numpy", "gtsam", "kiss-icp", "open3d", "small-gicp", "numba", "scipy", "mcap")
"""Whose versions a log records: those that its figures depend on."""
PROTOBUF_TOPICS = {
    schema.TRANSFORMS: FrameTransform,
    schema.KEYFRAME: KeyframePoints,
    schema.POINTS: PointCloud,
    schema.ODOMETRY: PosesInFrame,
    schema.TRAJECTORY: PosesInFrame,
    schema.GROUND_TRUTH: PosesInFrame,
    schema.ACCEPTED: SceneUpdate,
    schema.REJECTED: SceneUpdate,
    schema.GRAPH: SceneUpdate,
}
CHUNK_BYTES = 4 * 2**20
"""Above the largest step by far: a chunk ends with its step, which makes a step complete or absent."""


class LogWriter:
    """Writes the steps of a run as they come; a context manager.

    Each step is handed to the operating system as one compressed chunk with a checksum. A failure of the disk raises
    SegslamError and leaves a file that ends with the last complete step.
    """

    def __init__(
        self,
        path: Path,
        *,
        config: Config,
        dataset: str = "",
        sequence: str = "",
        T_camera_lidar: Transform | None = None,
        reference: Trajectory | None = None,
    ) -> None:
        """`reference` holds true poses and `T_camera_lidar` the calibration, for KITTI: a replay has nothing else."""
        self._path = path
        self._drawing = Drawing(config.log)
        self._resolution_m = config.keyframes.resolution_m
        self._stamp_ns = 0
        try:
            self._file = _WholeWrites(path)
        except OSError as error:
            raise SegslamError(f"{path}: cannot write the log ({error.strerror}); name a folder to write to") from error
        self._mcap = Writer(
            cast(IO[bytes], self._file),  # writes, tells and flushes: all that MCAP's writer asks of a stream
            chunk_size=CHUNK_BYTES,
            compression=CompressionType[config.log.compression.upper()],
        )
        with self._guarded():
            self._mcap.start(library=f"segslam {version('segslam')}")
            for name, data in _metadata(config, dataset, sequence, T_camera_lidar).items():
                self._mcap.add_metadata(name, data)
            self._channels = _register_channels(self._mcap)
            if reference is not None and len(reference):
                self._add_reference(reference)

    def write(self, step: Step) -> None:
        """Add a step. Raises SegslamError if the disk is full or fails; what was complete before stays readable."""
        self._stamp_ns = step.stamp_ns
        with self._guarded():
            for topic, message in self._drawing.draw(step):
                self._add(topic, message.SerializeToString())
            if step.keyframe is not None:
                self._add_points(step.keyframe)
            if step.estimate is not None:
                self._add_estimate(step.estimate)
            self._add(schema.STEP, _json(codec(Step).encode(step)))

    def write_result(self, estimate: GraphEstimate, trajectory: Trajectory) -> None:
        """Add what the last optimisation gave, and the pose of every scan that follows from it."""
        with self._guarded():
            for topic, message in self._drawing.draw_estimate(estimate, stamp_ns=self._stamp_ns):
                self._add(topic, message.SerializeToString())
            self._add_estimate(estimate)
            self._add(schema.RESULT, _json(codec(Trajectory).encode(trajectory)))

    def close(self) -> None:
        """Write the index. Without it the log can be read as well, only not searched."""
        if not self._file.closed:
            with self._guarded():
                self._mcap.finish()
            self._file.close()

    def __enter__(self) -> "LogWriter":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _add(self, topic: str, data: bytes) -> None:
        self._mcap.add_message(self._channels[topic], self._stamp_ns, data, self._stamp_ns)

    def _add_reference(self, reference: Trajectory) -> None:
        self._stamp_ns = int(reference.stamp_ns[0])
        topic, path = ground_truth(reference, stamp_ns=self._stamp_ns)
        self._add(topic, path.SerializeToString())
        self._add(schema.REFERENCE, _json(codec(Trajectory).encode(reference)))

    def _add_points(self, keyframe: Keyframe) -> None:
        message = keyframe_points(keyframe.points, keyframe.labels, resolution_m=self._resolution_m)
        self._add(schema.KEYFRAME, message.SerializeToString())

    def _add_estimate(self, estimate: GraphEstimate) -> None:
        keyframe_ids = {"keyframe_ids": list(estimate.T_world_keyframe)}
        self._add(schema.ESTIMATE, _json(codec(GraphEstimate).encode(estimate) | keyframe_ids))

    @contextmanager
    def _guarded(self) -> Iterator[None]:
        """Hands all that is written within to the operating system, or cuts the file back to what was before."""
        if self._file.closed:
            raise SegslamError(f"{self._path}: the log is closed; open another to write more")
        complete = self._file.tell()
        try:
            yield
            self._mcap.flush()
        except BaseException as error:  # Ctrl-C in mid-record as well
            self._file.cut(complete)
            if not isinstance(error, OSError):
                raise
            raise SegslamError(
                f"{self._path}: cannot go on writing the log ({error.strerror}); make room on the disk; "
                "the log ends with the last complete step"
            ) from error


class _WholeWrites:
    """The stream under MCAP's writer: unbuffered, so that a failure leaves nothing to be written later."""

    def __init__(self, path: Path) -> None:
        self._raw = path.open("wb", buffering=0)

    @property
    def closed(self) -> bool:
        return self._raw.closed

    def write(self, data: bytes) -> int:
        rest = memoryview(data)
        while rest:
            rest = rest[self._raw.write(rest) :]
        return len(data)

    def tell(self) -> int:
        return self._raw.tell()

    def flush(self) -> None:
        self._raw.flush()

    def cut(self, size: int) -> None:
        """Forget all after `size` bytes, and close."""
        self._raw.truncate(size)
        self._raw.close()

    def close(self) -> None:
        self._raw.close()


def _register_channels(mcap: Writer) -> dict[str, int]:
    """Topic -> channel; every topic is in the file from the start, with its schema."""
    schema_ids = {message: register_schema(mcap, message) for message in dict.fromkeys(PROTOBUF_TOPICS.values())}
    protobuf = {
        topic: mcap.register_channel(topic, "protobuf", schema_ids[message])
        for topic, message in PROTOBUF_TOPICS.items()
    }
    own = {
        topic: mcap.register_channel(
            topic, "json", mcap.register_schema(values["title"], "jsonschema", schema.schema_text(values))
        )
        for topic, values in schema.json_schemas().items()
    }
    return protobuf | own


def _metadata(
    config: Config, dataset: str, sequence: str, T_camera_lidar: Transform | None
) -> dict[str, dict[str, str]]:
    calibration = {} if T_camera_lidar is None else {"T_camera_lidar": json.dumps(T_camera_lidar.tolist())}
    return {
        schema.RUN_METADATA: {
            "schema_version": str(schema.VERSION),
            "dataset": dataset,
            "sequence": sequence,
            "python": platform.python_version(),
            "platform": platform.platform(),
            **calibration,
        },
        schema.CONFIG_METADATA: {"yaml": config_to_yaml(config)},
        schema.PACKAGES_METADATA: {name: _version(name) for name in PACKAGES},
    }


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:  # open3d has other distributions of the same import
        return "not installed"


def _json(values: dict[str, Any]) -> bytes:
    return json.dumps(values, allow_nan=False).encode()
