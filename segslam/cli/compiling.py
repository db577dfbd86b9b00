"""Compilation of the kernels before a command that needs them, if that was not done before."""

import logging

from segslam.cli.console import progress, say

logger = logging.getLogger(__name__)


def compile_kernels(*, quiet: bool) -> int:
    """Compile all kernels, with a bar, unless that was done before; how many were compiled.

    If it fails, each is compiled when it is first called.
    """
    from segslam.system import kernels

    if kernels.are_built():
        return 0
    total = kernels.num_kernels()
    say("first use on this machine: compiling, once, for 20 to 60 s", quiet=quiet)
    try:
        for _ in progress(kernels.build(), total=total, title="compile", quiet=quiet):
            pass
    except (RuntimeError, OSError) as error:
        logger.warning("%s; the run is slow at first", error)
    return total
