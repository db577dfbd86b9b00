"""Packages of this installation's extras, and how to install them."""

import re
import shlex
from importlib.metadata import PackageNotFoundError, requires, version
from typing import NamedTuple


class Requirement(NamedTuple):
    """A package that segslam needs."""

    package: str
    text: str
    """As pip takes it, for example `ros-rclpy[fastrtps]<10,>=7.1`."""
    extra: str | None
    """None if the package is always needed."""


def requirements() -> list[Requirement]:
    """All packages that this installation declares, without its own extras."""
    found = []
    for line in requires("segslam") or []:
        text = line.partition(";")[0].replace(" ", "")
        name = re.match(r"[\w.-]+", text)
        extra = re.search(r"extra == ['\"]([\w-]+)['\"]", line)
        if name and name[0] != "segslam":
            found.append(Requirement(name[0], text, extra[1] if extra else None))
    return found


def how_to_install(extra: str) -> str:
    """The command that installs the packages of an extra, wherever segslam was installed from."""
    return f"pip install {shlex.join(need.text for need in requirements() if need.extra == extra)}"


def installed_version(package: str) -> str | None:
    """The version of a package; None if it is not installed under this name."""
    try:
        return version(package)
    except PackageNotFoundError:
        return None
