"""Compiles the kernels, if necessary, before a command that needs them."""

import logging

from segslam.cli.console import progress, say

logger = logging.getLogger(__name__)


def compile_kernels(*, quiet: bool) -> int:
    """Compile all kernels, with a progress bar, unless they are compiled; returns the number of compiled kernels.

    On failure, each kernel is compiled on its first call.
    """
    from segslam.core import kernels

    if kernels.are_built():
        return 0
    total = kernels.num_kernels()
    say("first use on this machine: compiling, once, 20 to 60 s", quiet=quiet)
    try:
        for _ in progress(kernels.build(), total=total, title="compile", quiet=quiet):
            pass
    except (RuntimeError, OSError) as error:
        logger.warning("%s; the run starts slowly", error)
    return total
