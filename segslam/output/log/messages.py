"""What happens in a run, in words: messages of foxglove.Log for the Log panel of Foxglove."""

from collections.abc import Iterator

from foxglove_schemas_protobuf.Log_pb2 import Log

from segslam.core.types import LoopClosure, MotionState, Step, probability_text
from segslam.output.log.foxglove import timestamp

INFO, WARNING = Log.Level.Value("INFO"), Log.Level.Value("WARNING")
NAME = "segslam"
REPAIRS = (MotionState.REPAIRED, MotionState.REJOINED)


def warning(text: str, *, stamp_ns: int) -> Log:
    """A warning, for example about a scan that was skipped."""
    return Log(timestamp=timestamp(stamp_ns), level=WARNING, message=text, name=NAME)


def messages_of(step: Step) -> Iterator[Log]:
    """Repairs and breaks of the odometry as warnings, accepted loops as information."""
    motion = step.motion
    if motion is not None and motion.state in REPAIRS:
        by = "" if motion.moved_m is None else f", by {motion.moved_m:.2f} m"
        yield warning(f"scan {step.scan_index}: motion of the odometry repaired{by}", stamp_ns=step.stamp_ns)
    elif motion is not None and motion.state is MotionState.BROKEN:
        yield warning(f"scan {step.scan_index}: break, the scans do not support the motion", stamp_ns=step.stamp_ns)
    for attempt in step.attempts:
        if isinstance(attempt.outcome, LoopClosure):
            closure, found = attempt.outcome, attempt.outcome.alignment
            probable = "" if found.probability is None else probability_text(found.probability, found.evidence) + ", "
            text = (
                f"loop from keyframe {closure.source_id} to {closure.target_id}: {probable}"
                f"overlap {found.overlap:.2f}, residual {found.rms_m:.2f} m"
            )
            yield Log(timestamp=timestamp(step.stamp_ns), level=INFO, message=text, name=NAME)
