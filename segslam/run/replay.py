"""Loop closing and optimisation again, from the log of a run."""

from collections.abc import Sequence
from pathlib import Path

from segslam.core.config import Config, changed_settings, load_config
from segslam.core.types import SegslamError
from segslam.output.accuracy import accuracy
from segslam.output.finished import FinishedRun, read_run
from segslam.output.folder import copy_alone, log_of, new_folder, write_metrics
from segslam.output.log import RunLog, read_log
from segslam.run.run import Run
from segslam.slam.loop_edits import LoopEdits
from segslam.slam.slam import Slam

BEFORE_THE_KEYFRAMES = ("sensor", "odometry", "keyframes", "geometric")
"""Sections of the settings that a replay cannot change, because the log contains their results."""
NO_EDITS = LoopEdits()


def replay(
    run: str | Path, out: str | Path, *, settings: Sequence[str] = (), edits: LoopEdits = NO_EDITS
) -> FinishedRun:
    """Repeat loop closing and optimisation of a run into the new folder `out`, like `segslam replay` and `edit`.

    `run`: its folder or log.mcap. `settings`: changes such as `"verify.max_false_share=0.01"`; `edits` forbids and adds
    loops. Raises SegslamError for a setting that cannot be changed, and for a run localised in the map of another.
    """
    from segslam.output.report import write_report

    recorded = read_log(log_of(Path(run)))
    if recorded.options.get("in_map"):
        raise SegslamError(f"{run}: localised in the map of another run; use the command `segslam replay`")
    config = load_config(None, settings, base=recorded.config)
    check_settings(config, recorded)
    edits = LoopEdits.from_json(recorded.options.get("edits", "")).and_then(edits)
    reference, folder = recorded.reference(), new_folder(Path(out))
    with Run(
        folder,
        Slam(config, edits=edits),
        dataset=recorded.run.get("dataset", ""),
        T_camera_lidar=recorded.T_camera_lidar,
        reference=reference,
        options={} if edits == NO_EDITS else {"edits": edits.to_json()},
    ) as made:
        copy_alone(recorded.path.parent, folder)
        for _ in made.repeat(recorded.steps()):
            pass
        result, metrics = made.finish()
    if reference is not None:
        metrics |= accuracy(result, reference)
    write_metrics(folder, metrics)
    write_report(folder)
    return read_run(folder)


def check_settings(settings_now: Config, recorded: RunLog) -> None:
    """Raises SegslamError for a change that would have no effect."""
    for key, before, _ in changed_settings(recorded.config, settings_now):
        if key.partition(".")[0] in BEFORE_THE_KEYFRAMES:
            raise SegslamError(
                f"{key}: a replay uses the keyframes of {recorded.path}, which were made with {before}; "
                "keep this value, or map the data again"
            )
