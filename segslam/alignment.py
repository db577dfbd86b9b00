"""Two scans, from points to a verified pose: describe and prepare each once, then match, refine and verify a pair."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from time import perf_counter

from segslam import geometry, refine, segregator, verify
from segslam.beside import both
from segslam.config import Config, VerifyConfig
from segslam.semantics import geometric_labels
from segslam.types import Alignment, Description, Labels, Points, Registration, Rejected, RejectReason

Labeller = Callable[[Points], Labels]


class Stopwatch:
    """Seconds by stage; a stage entered twice adds up."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """The time within goes to this stage."""
        started = perf_counter()
        try:
            yield
        finally:
            self.add(stage, perf_counter() - started)

    def add(self, stage: str, seconds: float) -> None:
        """What was measured elsewhere, in seconds."""
        self.seconds[stage] = self.seconds.get(stage, 0.0) + seconds


@dataclass(frozen=True, slots=True, eq=False)
class PreparedScan:
    """All that aligning a scan needs, made once a scan."""

    description: Description
    surface: refine.Surface
    view: verify.View


def register(
    source_points: Points,
    target_points: Points,
    *,
    source_labels: Labels | None = None,
    target_labels: Labels | None = None,
    config: Config | None = None,
) -> Alignment | Rejected:
    """The pose of one scan in another, with no initial guess, each in its own sensor's frame (z up, metres).

    Labels are learning ids, a row a point; scans without are labelled by shape. The pose is `fine.T_target_source`.
    """
    config = config or Config()

    def prepared(points: Points, labels: Labels | None) -> PreparedScan:
        return prepare_scan(points, shape_labels(points, config=config) if labels is None else labels, config=config)

    source, target = both(prepared, (source_points, source_labels), (target_points, target_labels))
    return align(source, target, config=config)


def shape_labels(points: Points, *, config: Config) -> Labels:
    """Labels by shape alone."""
    return geometric_labels(points, config=config.geometric)


def prepare_scan(points: Points, labels: Labels, *, config: Config) -> PreparedScan:
    """Describe a scan and make its surface ready; `points` in the scan's own frame."""
    return PreparedScan(
        description=segregator.describe(points, labels, config=config.segregator),
        surface=refine.prepare(refine.thin(points, config=config.refine), config=config.refine),
        view=verify.view(points),
    )


def align(
    source: PreparedScan,
    target: PreparedScan,
    *,
    config: Config,
    gate: Callable[[Registration], Rejected | None] = lambda coarse: None,
    watch: Stopwatch | None = None,
) -> Alignment | Rejected:
    """The pose of the source in the target, found with no initial guess, refined and verified; or why there is none.

    The best few hypotheses are tried in their order, and the first that stands is kept. `gate` may turn down a coarse
    pose before it is refined. Where none stands, the rejection is that of the best.
    """
    watch = watch or Stopwatch()
    rejections = []
    for coarse in _coarse(source, target, config=config, watch=watch):
        if isinstance(coarse, Rejected):
            rejections.append(coarse)
            continue
        outcome = gate(coarse) or _sharpened(source, target, coarse, config=config, watch=watch)
        if isinstance(outcome, Alignment):
            return outcome
        rejections.append(outcome)
    return rejections[0]


def _coarse(
    source: PreparedScan, target: PreparedScan, *, config: Config, watch: Stopwatch
) -> Iterator[Registration | Rejected]:
    """Those of clusters and features; after these, those of floor plans where both scans know which way is up."""
    with watch("match"):
        ranked = segregator.hypotheses(source.description, target.description, config=config.segregator)
    yield from [ranked] if isinstance(ranked, Rejected) else ranked[: config.verify.max_hypotheses]
    num_plans = config.verify.max_plan_hypotheses
    source_up, target_up = segregator.upward(source.description), segregator.upward(target.description)
    if num_plans == 0 or source_up is None or target_up is None:
        return
    with watch("match"):
        plans = list(
            segregator.plan_hypotheses(
                source.surface.standing,
                target.surface.standing,
                source_up,
                target_up,
                num_poses=num_plans,
            )
        )
    yield from plans


def _sharpened(
    source: PreparedScan, target: PreparedScan, coarse: Registration, *, config: Config, watch: Stopwatch
) -> Alignment | Rejected:
    """One hypothesis, refined and verified."""
    if coarse.num_inliers < config.verify.min_inliers:
        return Rejected(RejectReason.TOO_FEW_INLIERS, f"{coarse.num_inliers} < {config.verify.min_inliers}")
    scans = (source.surface, source.view), (target.surface, target.view)
    with watch("verify"):
        if hopeless := verify.early_rejection(*scans, coarse.T_target_source, config=config.verify):
            return hopeless
    with watch("refine"):
        fine = refine.refine(source.surface, target.surface, coarse.T_target_source, config=config.refine)
    if isinstance(fine, Rejected):
        return fine
    with watch("verify"):
        return _verified(*scans, coarse, fine, config=config.verify)


def _verified(
    source: tuple[refine.Surface, verify.View],
    target: tuple[refine.Surface, verify.View],
    coarse: Registration,
    fine: Registration,
    *,
    config: VerifyConfig,
) -> Alignment | Rejected:
    moved_m = geometry.distance(geometry.inverse(coarse.T_target_source) @ fine.T_target_source)
    if moved_m > config.max_coarse_fine_m:
        detail = f"moved {moved_m:.2f} m > {config.max_coarse_fine_m} m"
        return Rejected(RejectReason.REFINEMENT_DIVERGED, detail)
    found = verify.agreement(source, target, fine.T_target_source, config=config)
    return verify.rejection(found, config=config) or Alignment(
        coarse=coarse,
        fine=fine,
        overlap=found.overlap,
        rms_m=found.rms_m,
        free_space_violation=found.free_space_violation,
    )
