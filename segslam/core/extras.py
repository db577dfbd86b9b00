"""Packages of this installation's extras, and how to install them."""

import re
import shlex
from importlib.metadata import PackageNotFoundError, requires, version
from typing import NamedTuple


class Requirement(NamedTuple):
    """A package that segslam needs."""

    package: str
    options: str
    """Extras of the package, for example `[fastrtps]`, or nothing."""
    versions: str
    """As pip takes them, for example `<2,>=1.20`."""
    extra: str | None
    """None if the package is always needed."""


def requirements() -> list[Requirement]:
    """All packages that this installation declares, without its own extras."""
    found = []
    for line in requires("segslam") or []:
        name = re.match(r"([\w.-]+)(\[[^\]]*\])? *([^; ]*)", line)
        extra = re.search(r"extra == ['\"]([\w-]+)['\"]", line)
        if name and name[1] != "segslam":
            found.append(Requirement(name[1], name[2] or "", name[3], extra[1] if extra else None))
    return found


def how_to_install(extra: str) -> str:
    """The command that installs the packages of an extra, wherever segslam was installed from."""
    packages = [f"{need.package}{need.options}{need.versions}" for need in requirements() if need.extra == extra]
    return f"pip install {shlex.join(packages)}"


def installed_version(package: str) -> str | None:
    """The version of a package; None if it is not installed under this name."""
    try:
        return version(package)
    except PackageNotFoundError:
        return None
