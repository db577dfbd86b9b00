import subprocess
import sys

import pytest

FAULTS = """
import resource
import numpy as np
from segslam.system.memory import keep_freed_memory
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
