"""Exceptions. Separate from the records, so that the command line starts without NumPy."""

import errno
import os
import re


class SegslamError(Exception):
    """Bad input or misuse: the message names the file or key and the remedy."""


class WorkFailed(SegslamError):
    """A valid request that failed, for example because of a full disk."""


class BadScan(SegslamError):
    """A scan that cannot be used; other scans are not affected. Report it, skip it, count it."""


class LateScan(BadScan):
    """A scan whose stamp is not later than that of the previous scan."""


def brief(text: str, num_characters: int = 80) -> str:
    """The text on one line, cut to a length that a person reads."""
    text = " ".join(text[: 4 * num_characters].split())
    return text if len(text) <= num_characters else f"{text[:num_characters]}..."


def counted(number: int, thing: str) -> str:
    """A number and its noun, in the plural if it is not 1."""
    return f"{number} {noun(number, thing)}"


def noun(number: float, thing: str) -> str:
    """A noun, in the plural if its number is not 1."""
    return thing if number == 1 else f"{thing}s"


def unreadable(path: object, content: str, error: Exception) -> str:
    """Start of the message about a file that is missing, or whose content cannot be read; a remedy follows."""
    if isinstance(error, FileNotFoundError):
        return f"{path}: no such file"
    return f"{path}: cannot read the {content} ({reason(error) if isinstance(error, OSError) else error})"


def how_to_write(error: OSError) -> str:
    """The remedy for a file that cannot be written: permission, or space."""
    is_forbidden = error.errno in (errno.EROFS, errno.EACCES, errno.EPERM)
    return "make it writable" if is_forbidden else "free space there"


def reason(error: OSError) -> str:
    """Short reason of an error; NumPy's errors have no `strerror`, and give item counts if the disk is full."""
    if error.strerror is None and re.fullmatch(r"\d+ requested and \d+ written", str(error)):
        return os.strerror(errno.ENOSPC)
    return error.strerror or str(error) or type(error).__name__
