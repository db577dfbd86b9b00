"""`segslam warm-up`."""

from time import perf_counter

from segslam.cli.compiling import compile_kernels
from segslam.cli.console import JsonOption, QuietOption, print_json, say
from segslam.system.interrupts import when_stopped


def warm_up(json: JsonOption = False, quiet: QuietOption = False) -> None:
    """Compile all numba kernels now, so that the first run does not have to: after installing, or in a container image.

    Compiled code is kept in NUMBA_CACHE_DIR if that is set, else beside the package, or in the user's cache folder
    where the package cannot be written to.

    Example: segslam warm-up
    """
    when_stopped("what was compiled so far is kept; the same command compiles the rest")
    started = perf_counter()
    num_compiled = compile_kernels(quiet=quiet)
    seconds = perf_counter() - started
    if json:
        print_json({"seconds": seconds, "num_compiled": num_compiled})
    elif num_compiled:
        say(f"ready in {seconds:.1f} s; {num_compiled} kernels were compiled", quiet=quiet)
    else:
        say("ready: the kernels were compiled before", quiet=quiet)
