"""Metadata of a log: how its run was made."""

import json
import os
import platform
import re
import shlex
import sys
from collections.abc import Mapping
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from segslam.core.config import Config, config_to_yaml
from segslam.core.types import Transform
from segslam.output.log import schema

CPU_INFO = Path("/proc/cpuinfo")
ESCAPED = re.compile(r"\\u(dc[89a-f][0-9a-f])")
"""A byte of a file name that is not UTF-8, as Python writes it (PEP 383)."""
PACKAGES = ("segslam", "numpy", "gtsam", "kiss-icp", "open3d", "small-gicp", "numba", "scipy", "mcap")
"""Packages whose versions a log records, because results depend on them."""


def metadata(
    config: Config, dataset: str, T_camera_lidar: Transform | None, options: Mapping[str, str]
) -> dict[str, dict[str, str]]:
    """Metadata records by name, as documented in `schema`."""
    calibration = {} if T_camera_lidar is None else {"T_camera_lidar": json.dumps(T_camera_lidar.tolist())}
    written = {
        schema.RUN_METADATA: {
            "schema_version": str(schema.VERSION),
            "dataset": dataset,
            "python": platform.python_version(),
            "platform": platform.platform(),
            "started": datetime.now(UTC).isoformat(timespec="seconds"),
            "command": _command(),
            "processor": f"{_processor()}, {os.cpu_count()} cores",
            **calibration,
        },
        schema.CONFIG_METADATA: {"yaml": config_to_yaml(config)},
        schema.OPTIONS_METADATA: dict(options),
        schema.PACKAGES_METADATA: {name: _version(name) for name in PACKAGES},
    }
    records = {name: {key: _printable(text) for key, text in values.items()} for name, values in written.items()}
    return {**records, schema.CHECK_METADATA: {"crc32": str(schema.checksum(records))}}


def _printable(text: str) -> str:
    """The text with bytes of file names that are not UTF-8, which a log cannot hold, as escapes."""
    return text.replace(r"\udc", r"\x5cudc").encode(errors="backslashreplace").decode()


def restored(values: Mapping[str, str]) -> dict[str, str]:
    """The values of a metadata record with the bytes of which `metadata` has made escapes."""

    def as_it_was(text: str) -> str:
        return ESCAPED.sub(lambda found: chr(int(found[1], 16)), text).replace(r"\x5cudc", r"\udc")

    return {key: as_it_was(value) for key, value in values.items()}


def _command() -> str:
    name = Path(sys.argv[0]).name
    return shlex.join(["segslam" if name == "__main__.py" else name, *sys.argv[1:]])


def _processor() -> str:
    """Name of the processor from Linux; on other systems, from Python."""
    if CPU_INFO.is_file():
        for line in CPU_INFO.read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:  # open3d is also distributed under other names
        return "not installed"
