"""Scans as files, and what happens to files: cut, renamed, deleted, overwritten, of the wrong type."""

import os
import random
from collections.abc import Callable
from pathlib import Path

import numpy as np

HOUR_NS = 3600 * 10**9


def write_whole(folder: Path, rows: np.ndarray, name: str) -> Path:
    """Write a scan like a recorder: under a hidden name until it is complete."""
    part, file = folder / f".{name}", folder / name
    rows.astype("<f4").tofile(part)
    return part.rename(file)


def whole(folder: Path, rows: np.ndarray, name: str, rng: random.Random) -> int:
    """A file without a fault."""
    write_whole(folder, rows, name)
    return 1


def cut(folder: Path, rows: np.ndarray, name: str, rng: random.Random) -> int:
    """A file that ends anywhere."""
    content = rows.astype("<f4").tobytes()
    (folder / name).write_bytes(content[: rng.randrange(len(content))])
    return 1


def empty(folder: Path, rows: np.ndarray, name: str, rng: random.Random) -> int:
    """A file without content."""
    (folder / name).touch()
    return 1


def deleted(folder: Path, rows: np.ndarray, name: str, rng: random.Random) -> int:
    """A file that is removed at once, or while it waits."""
    write_whole(folder, rows, name)
    if rng.random() < 0.5:
        os.sched_yield()
    (folder / name).unlink()
    return 1


def renamed(folder: Path, rows: np.ndarray, name: str, rng: random.Random) -> int:
    """A file that gets another name, which is another scan."""
    write_whole(folder, rows, name).rename(folder / f"again{name}")
    return 2


def wrong_type(folder: Path, rows: np.ndarray, name: str, rng: random.Random) -> int:
    """Text, an archive, and headers that claim too much, under the names of scans; a folder; a pipe."""
    stem = Path(name).stem
    match rng.randrange(6):
        case 0:
            (folder / name).write_text("no scan\n" * 50)
        case 1:
            (folder / f"{stem}.npy").write_bytes(b"PK\x03\x04" + bytes(100))
        case 2:
            head = "{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000, 4), }"
            (folder / f"{stem}.npy").write_bytes(b"\x93NUMPY\x01\x00" + len(head).to_bytes(2, "little") + head.encode())
        case 3:
            (folder / f"{stem}.npy").write_bytes(rng.randbytes(200))
        case 4:
            (folder / f".{name}").mkdir()
            (folder / f".{name}").rename(folder / name)
        case _:
            os.mkfifo(folder / f".{name}")
            (folder / f".{name}").rename(folder / name)
    return 1


def odd_points(folder: Path, rows: np.ndarray, name: str, rng: random.Random) -> int:
    """Coordinates that are not finite, or farther than any sensor sees; few points; one point many times."""
    odd = rows.copy()
    match rng.randrange(4):
        case 0:
            odd[::7, rng.randrange(3)] = rng.choice((np.nan, np.inf, 1e18, float(np.finfo(np.float32).max)))
        case 1:
            odd[:] = np.nan
        case 2:
            odd = odd[: rng.randrange(1, 60)]
        case _:
            odd[:] = odd[0]
    return whole(folder, odd, name, rng)


def overwritten(folder: Path, rows: np.ndarray, name: str, rng: random.Random) -> int:
    """A name that is used again: the recorder's `latest.bin`."""
    return whole(folder, rows, "latest.bin", rng)


def clock_set_back(folder: Path, rows: np.ndarray, name: str, rng: random.Random) -> int:
    """A file that is an hour old."""
    part = folder / f".{name}"
    rows.astype("<f4").tofile(part)
    old_ns = part.stat().st_mtime_ns - HOUR_NS
    os.utime(part, ns=(old_ns, old_ns))
    part.rename(folder / name)
    return 1


def odd_stamp(folder: Path, rows: np.ndarray, name: str, rng: random.Random) -> int:
    """A name that is read as a stamp, of no time."""
    return whole(folder, rows, f"{rng.randrange(5 * 10**18, 10**19):019d}.bin", rng)


FileFault = Callable[[Path, np.ndarray, str, random.Random], int]
"""Writes a scan with a fault into a folder under a name; returns the number of scans that a watcher sees."""
FAULTS = (cut, empty, deleted, renamed, wrong_type, odd_points, overwritten, clock_set_back, odd_stamp)
LIVE: dict[str, FileFault] = {fault.__name__: fault for fault in FAULTS}
OFFLINE = [fault.__name__ for fault in (cut, empty, odd_points)]
"""Those that a folder shows to `segslam map`."""
