import subprocess
import sys

import pytest

from segslam.core import memory
from segslam.core.memory import note_peak_of, peak_mb

FAULTS = """
import resource
import numpy as np
from segslam.core.memory import keep_freed_memory
{keep}
def faults():
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt
before = faults()
for _ in range(50):
    arrays = [np.ones(3 * 120_000) for _ in range(6)]
    del arrays
print(faults() - before)
"""


def _faults(keep: str) -> int:
    """Page faults of 50 times six arrays of a scan's size."""
    program = FAULTS.format(keep=keep)
    return int(subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout)


@pytest.mark.skipif(sys.platform != "linux", reason="glibc")
def test_arrays_of_a_scans_size_are_made_of_pages_that_are_there() -> None:
    pages = 6 * 3 * 120_000 * 8 // 4096
    assert _faults("keep_freed_memory()") < 3 * pages
    assert _faults("") > 20 * pages, "or the setting is of no use any more"


@pytest.mark.skipif(sys.platform != "linux", reason="/proc")
def test_the_peak_of_another_process_does_not_contain_that_of_this_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "_together_mb", 0.0)  # of larger ones in earlier tests
    program = "import sys; kept = bytearray(40 * 2**20); print(); sys.stdout.flush(); sys.stdin.read()"
    alone_mb = peak_mb()
    with subprocess.Popen([sys.executable, "-c", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
        assert other.stdout is not None
        other.stdout.readline()
        note_peak_of(other.pid)
        other.communicate()
    assert 40.0 < peak_mb() - alone_mb < 80.0
    note_peak_of(other.pid)  # it has ended
    together_mb = peak_mb()
    assert together_mb - alone_mb > 40.0
    later = b"x" * (int(together_mb + 20.0 - alone_mb) * 2**20)
    assert peak_mb() - together_mb < 40.0, "taken after the other process has ended, so not added to its memory"
    del later
