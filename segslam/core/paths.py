"""Paths as users give them."""

from pathlib import Path

from segslam.core.errors import SegslamError, brief


def expanded(path: str | Path) -> Path:
    """The path with the home folder in place of `~`. Raises SegslamError for a user who does not exist."""
    try:
        return Path(path).expanduser()
    except RuntimeError as error:
        raise SegslamError(f"{brief(str(path))}: there is no user with this name; write the folder in full") from error
