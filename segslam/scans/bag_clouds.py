"""Point clouds on one topic of ROS bags: .bag files of ROS 1, and folders of ROS 2."""

import weakref
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

from segslam.core.config.yaml_text import parse_yaml
from segslam.core.extras import how_to_install
from segslam.scans.in_order import InOrder
from segslam.scans.mcap_clouds import MESSAGE


class BagClouds:
    """Messages with clouds, read in order. Replaces kiss_icp's reader, which ends the program for a missing topic.

    Raises ValueError if the bag has no such topic, SegslamError if its metadata are damaged, ImportError if the package
    is missing, and what rosbags raises.
    """

    is_sequential = True

    def __init__(self, data: Path, topic: str) -> None:
        try:
            from rosbags.highlevel import AnyReader
        except ImportError as error:
            raise ImportError(f"reading ROS bags needs a package: {how_to_install('recordings')}") from error
        files = [file for file in sorted(data.glob("*.bag")) if not file.name.startswith(".")] if data.is_dir() else []
        metadata = data / "metadata.yaml"
        if not files and metadata.is_file():
            # rosbags needs seconds before it refuses a damaged text that is nested deeply
            parse_yaml(metadata.read_text(encoding="utf-8"), str(metadata))
        self._bag = AnyReader(files or [data])
        self._bag.open()
        weakref.finalize(self, _close, self._bag)
        counts = {name: info.msgcount for name, info in self._bag.topics.items() if info.msgtype == MESSAGE}
        found = [name for name in counts if name == topic or not topic]
        if len(found) != 1:
            known = ", ".join(f"--topic {name}" for name in sorted(counts)) or "none"
            raise ValueError(f"give one topic of type {MESSAGE}; the recording has: {known}")
        self._connections = [connection for connection in self._bag.connections if connection.topic == found[0]]
        stored = [file for path in files or [data] for file in ([path] if path.is_file() else path.iterdir())]
        self._raw = InOrder(
            self._messages, counts[found[0]], num_bytes=sum(file.stat().st_size for file in stored if file.is_file())
        )

    def __len__(self) -> int:
        return len(self._raw)

    def __getitem__(self, index: int) -> tuple[int, Any]:
        """Log time (ns) and decoded message. Raises what rosbags raises for a damaged one."""
        log_ns, data, kind = self._raw[index]
        return log_ns, self._bag.deserialize(data, kind)

    def _messages(self) -> Iterator[tuple[int, bytes, str]]:
        for connection, log_ns, data in self._bag.messages(connections=self._connections):
            yield log_ns, data, connection.msgtype


def _close(bag: Any) -> None:
    with suppress(Exception):  # of a damaged database; nothing is written
        bag.close()
