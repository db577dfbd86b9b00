"""Functions compiled by numba, on their first call or all at once by `build`. The compiled code is cached on disk.

numba is imported with the first kernel that is called: commands that call none start without it.
"""

import hashlib
import os
import platform
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator, Sequence
from functools import cache, update_wrapper
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeVar, cast

Function = TypeVar("Function", bound=Callable[..., Any])

PACKAGE = Path(__file__).resolve().parents[1]
MODULES = (
    "registration.segregator.descent",
    "registration.cliques",
    "registration.segregator.fpfh",
    "registration.segregator.consistency_graph",
    "labels.ground_surface",
    "labels.range_image",
    "registration.segregator.plan",
    "registration.segregator.correspondences",
    "graph.closure_pairs",
    "output.map.views",
    "scans.pcd",
    "slam.adjustment.alignment",
    "odometry.nudge",
    "core.points",
)
"""Modules of this package that define kernels, the slowest to compile first."""
DONE = "done "
"""Start of the line that a process prints for each compiled kernel."""

_all: list["Kernel"] = []
_lock = threading.RLock()


class Kernel:
    """A function compiled for one signature on its first call; other kernels may call it."""

    def __init__(self, function: Callable[..., Any], signature: str) -> None:
        update_wrapper(self, function)
        self.py_func = function
        self.signature = signature
        self._compiled: Any = None

    def __call__(self, *arguments: Any) -> Any:  # noqa: D102
        return (self._compiled or self.compiled)(*arguments)

    @property
    def compiled(self) -> Any:
        """numba's dispatcher, which accepts no other signature."""
        with _lock:
            if self._compiled is None:
                self._compiled = _compile(self.py_func, self.signature)
        return self._compiled


def kernel(signature: str) -> Callable[[Function], Function]:
    """Decorator: compile a function of numbers and arrays for a numba signature; it releases the global lock."""

    def decorate(function: Function) -> Function:
        made = Kernel(function, signature)
        _all.append(made)
        return cast(Function, made)

    return decorate


def num_kernels(modules: Sequence[str] = MODULES) -> int:
    """Number of kernels in these modules."""
    return sum(_file(name).read_text(encoding="utf-8").count("\n@kernel(") for name in modules)


def are_built(modules: Sequence[str] = MODULES) -> bool:
    """True if `build` has compiled the current kernels for this machine and these versions."""
    return _stamp(modules).exists()


def build(modules: Sequence[str] = MODULES) -> Iterator[str]:
    """Compile all kernels of these modules in two processes; yields the name of each when it is done.

    Raises RuntimeError, with the last lines that the processes wrote, if both fail.
    """
    from_processes, pipe = os.pipe()
    processes = [_start(modules, pipe, backwards=backwards) for backwards in (False, True)]
    os.close(pipe)
    total, done, others = num_kernels(modules), set[str](), list[str]()
    try:
        with open(from_processes, encoding="utf-8", errors="replace") as lines:
            for line in map(str.strip, lines):
                name = line.removeprefix(DONE)
                if name == line:
                    others.append(line)
                elif name not in done:
                    done.add(name)
                    yield name
                if len(done) == total:
                    break
            else:
                raise RuntimeError(f"the kernels were not compiled: {' '.join(others[-3:]) or 'a process was stopped'}")
    finally:
        for process in processes:
            process.kill()  # no effect on a process that has ended
            process.wait()
    stamp = _stamp(modules)
    stamp.parent.mkdir(parents=True, exist_ok=True)
    stamp.touch()


def cache_folder() -> Path | None:
    """Folder of the cache, or None for numba's default beside the modules.

    NUMBA_CACHE_DIR if it is set and writable; the default if it is writable; otherwise a folder of the user, or one in
    the folder for temporary files.
    """
    given = os.environ.get("NUMBA_CACHE_DIR")
    if given and _can_write(Path(given)):
        return Path(given)
    if all(os.access(_file(name).parent, os.W_OK) for name in MODULES):
        return None
    home = Path(os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser()) / "segslam"
    return home if _can_write(home) else Path(tempfile.gettempdir()) / f"segslam-{os.getuid()}"


def _can_write(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return False
    return os.access(folder, os.W_OK | os.X_OK)


def _compile(function: Callable[..., Any], signature: str) -> Any:
    numba = _numba()
    before = numba.config.CACHE_DIR
    numba.config.CACHE_DIR = str(cache_folder() or "")
    try:
        return numba.njit(signature, nogil=True, cache=True)(function)
    except RuntimeError as error:
        if "cannot cache" not in str(error):
            raise
        return numba.njit(signature, nogil=True)(function)  # no writable cache, as on a full disk
    finally:
        numba.config.CACHE_DIR = before


@cache
def _numba() -> Any:
    """numba, extended so that a kernel called by another kernel has the type of its compiled function."""
    import numba
    from numba.core.types import Dispatcher
    from numba.extending import typeof_impl

    @typeof_impl.register(Kernel)
    def _type(kernel: Kernel, _: Any) -> Any:
        return Dispatcher(kernel.compiled)

    return numba


def _stamp(modules: Sequence[str]) -> Path:
    """The file that `build` writes; its name is a digest of source, versions and processor."""
    digest = hashlib.sha256()
    for name in modules:
        about = _file(name).stat()
        digest.update(f"{name} {about.st_mtime_ns} {about.st_size}\n".encode())
    versions = [platform.python_version(), *(version(package) for package in ("numba", "llvmlite", "numpy"))]
    digest.update(f"{versions} {platform.machine()} {_processor()}".encode())
    return (cache_folder() or PACKAGE / "__pycache__") / f"kernels-{digest.hexdigest()[:16]}.built"


def _processor() -> str:
    """The lines that identify the processor, on Linux."""
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8")
    except OSError:
        return platform.processor()
    return "".join(line for line in text.partition("\n\n")[0].splitlines() if line.startswith(("model name", "flags")))


def _start(modules: Sequence[str], pipe: int, *, backwards: bool) -> subprocess.Popen[bytes]:
    code = f"from segslam.core.kernels import _build; _build({list(modules)}, backwards={backwards})"
    path = os.pathsep.join([str(PACKAGE.parent), *filter(None, sys.path)])
    return subprocess.Popen(
        [sys.executable, "-c", code], stdout=pipe, stderr=subprocess.STDOUT, env=os.environ | {"PYTHONPATH": path}
    )


def _build(modules: Sequence[str], *, backwards: bool) -> None:
    """Compile the kernels one by one, and print a line for each.

    Two processes start at opposite ends: each loads the kernels compiled by the other within milliseconds.
    """
    for name in reversed(modules) if backwards else modules:
        module = import_module(f"segslam.{name}")
        own = [kernel for kernel in _all if kernel.__module__ == module.__name__]
        for kernel in reversed(own) if backwards else own:
            kernel.compiled  # noqa: B018  (compiles on access)
            print(f"{DONE}{kernel.__module__}.{kernel.py_func.__qualname__}", flush=True)


def _file(module: str) -> Path:
    return PACKAGE.joinpath(*module.split(".")).with_suffix(".py")
