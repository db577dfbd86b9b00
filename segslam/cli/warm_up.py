"""`segslam warm-up`."""

from time import perf_counter

from segslam.cli.compiling import compile_kernels
from segslam.cli.console import JsonOption, QuietOption, print_json, say
from segslam.core.interrupts import when_stopped


def warm_up(json: JsonOption = False, quiet: QuietOption = False) -> None:
    """Compile all numba kernels now instead of in the first run, for example in a container image.

    Compiled code is stored in NUMBA_CACHE_DIR if set, otherwise beside the package, or in the user's cache folder if
    the package is read-only.

    Example: segslam warm-up
    """
    when_stopped("the kernels compiled so far are kept; the same command compiles the others")
    started = perf_counter()
    num_compiled = compile_kernels(quiet=quiet)
    seconds = perf_counter() - started
    if json:
        print_json({"seconds": seconds, "num_compiled": num_compiled})
    elif num_compiled:
        say(f"ready in {seconds:.1f} s; {num_compiled} kernels were compiled", quiet=quiet)
    else:
        say("ready: all kernels are compiled", quiet=quiet)
