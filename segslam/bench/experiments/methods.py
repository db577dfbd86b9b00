"""All registration methods behind one interface: the data they need per scan, their alignment of two, and its cost."""

import importlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter, process_time
from typing import Any

from segslam import verification as registration
from segslam.bench.experiments import baselines
from segslam.bench.experiments.baselines import Estimate
from segslam.bench.experiments.method_settings import check_method, method_config
from segslam.core.config import Config
from segslam.core.extras import how_to_install
from segslam.core.memory import give_back, status_mb
from segslam.core.threads import Stopwatch
from segslam.core.types import Alignment, Description, Labels, Points, Registration, Rejected, SegslamError
from segslam.registration import refinement, segregator
from segslam.registration.free_space import FreeSpace
from segslam.registration.prepared import Observed, PreparedScan

CLEAR_REFS = Path("/proc/self/clear_refs")
RESET_PEAK = "5"
"""Value that, written to `clear_refs`, resets the peak memory to the current memory (Linux, proc(5))."""


@dataclass(slots=True)
class Cost:
    """Time and memory; the fields are set when the measured block ends."""

    seconds: float = 0.0
    cpu_seconds: float = 0.0
    """CPU time of all threads; more reliable than `seconds` on a busy machine."""
    peak_mb: float | None = None
    """Peak of additional memory; None if unknown. Invalid while other threads of the process work."""


Values = Mapping[str, Any]
"""The parts of one scan by name."""
Parts = tuple[dict[str, Any], dict[str, Cost]]
"""The parts of one scan, and their costs."""


@dataclass(frozen=True, slots=True)
class Method:
    """Aligns two scans, given the parts of each that it names."""

    parts: tuple[str, ...]
    align: Callable[[Values, Values, Config, Stopwatch], Estimate | Rejected]
    package: str | None = None
    """Module of the extra `bench`, if the package is optional or slow to import."""


def _surface(points: Points, _: Labels, config: Config) -> Observed:
    downsampled = refinement.downsample(points, config=config.refine)
    return Observed(refinement.Surface(downsampled, config.refine), FreeSpace(points))


def _description(method: str) -> Callable[[Points, Labels, Config], Description]:
    """Description of a scan with the settings of a method."""
    return lambda points, labels, config: segregator.describe(
        points, labels, config=method_config(config, method).segregator
    )


PARTS: dict[str, Callable[[Points, Labels, Config], Any]] = {
    "description": _description("segregator"),
    "fpfh_description": _description("teaser"),
    "surface": _surface,
    "gicp": lambda points, *_: baselines.prepare_gicp(points),
    "fpfh": lambda points, *_: baselines.prepare_fpfh(points),
    "points": lambda points, *_: points.astype("float32"),
}
"""The parts by name, from points, labels and configuration."""


@contextmanager
def measured() -> Iterator[Cost]:
    """Context manager that yields the cost of its block."""
    cost = Cost()
    give_back()
    before_mb = None
    with suppress(OSError):
        CLEAR_REFS.write_text(RESET_PEAK)
        before_mb = status_mb("VmRSS")
    started, cpu_started = perf_counter(), process_time()
    yield cost
    cost.seconds, cost.cpu_seconds = perf_counter() - started, process_time() - cpu_started
    if before_mb is not None:
        cost.peak_mb = max((status_mb("VmHWM") or 0.0) - before_mb, 0.0)


def prepare_parts(points: Points, labels: Labels, *, methods: Iterable[str], config: Config) -> Parts:
    """All parts of a scan that these methods need, each computed once, and their costs."""
    values, costs = {}, {}
    for name in dict.fromkeys(part for method in methods for part in METHODS[method].parts):
        with measured() as costs[name]:
            values[name] = PARTS[name](points, labels, config)
    return values, costs


def find_method(name: str) -> Method:
    """The method of a name. Raises SegslamError if it is unknown or its package is not installed."""
    check_method(name)
    method = METHODS[name]
    if method.package is not None:
        try:
            importlib.import_module(method.package)
        except ImportError as error:
            raise SegslamError(f"--method {name}: needs {method.package}: {how_to_install('bench')}") from error
    return method


def _segregator(name: str, part: str = "description") -> Method:
    """Segregator's coarse pose with the settings of a method."""

    def run(source: Values, target: Values, config: Config, watch: Stopwatch) -> Estimate | Rejected:
        with watch("match"):
            found = segregator.match(source[part], target[part], config=method_config(config, name).segregator)
        return found if isinstance(found, Rejected) else _estimate(found, found)

    return Method((part,), run)


def _align(source: Values, target: Values, config: Config, watch: Stopwatch) -> Estimate | Rejected:
    scans = (
        PreparedScan(values["surface"].surface, values["surface"].free_space, values["description"])
        for values in (source, target)
    )
    found = registration.register_prepared(*scans, config=config, watch=watch)
    if isinstance(found, Alignment):
        estimate = _estimate(found.coarse, found.fine)
        return replace(estimate, overlap=found.overlap, probability=found.probability, evidence=found.evidence)
    return found


def _estimate(coarse: Registration, fine: Registration) -> Estimate:
    return Estimate(fine.T_target_source, coarse.num_correspondences, coarse.num_inliers, coarse.num_edges)


def _baseline(part: str, align: Callable[[Any, Any], Estimate | Rejected], package: str | None = None) -> Method:
    def run(source: Values, target: Values, config: Config, watch: Stopwatch) -> Estimate | Rejected:
        with watch("match"):
            return align(source[part], target[part])

    return Method((part,), run, package)


METHODS: dict[str, Method] = {
    "segregator": _segregator("segregator"),
    "segregator-c2f": Method(("description", "surface"), _align),
    "segator": _segregator("segator"),
    "teaser": _segregator("teaser", "fpfh_description"),
    "quatro": _segregator("quatro", "fpfh_description"),
    "vgicp": _baseline("gicp", baselines.align_vgicp),
    "gicp": _baseline("gicp", baselines.align_gicp),
    "kiss-matcher": _baseline("points", baselines.align_kiss_matcher, "kiss_matcher"),
    "ransac": _baseline("fpfh", baselines.align_ransac, "open3d"),
    "fgr": _baseline("fpfh", baselines.align_fgr, "open3d"),
}
