"""`segslam live`."""

import json as json_text
import shlex
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from importlib.util import find_spec
from pathlib import Path
from statistics import median
from time import monotonic
from typing import TYPE_CHECKING, Annotated, Any

import typer

from segslam.cli.checks import (
    check_exists,
    check_free,
    live_configs,
    make_folder,
    outside,
    remove_if_empty,
    show_preset,
)
from segslam.cli.console import Terminal, how_to_go_on
from segslam.cli.ending import finish
from segslam.cli.options import GnssOptions, PresetOption, RunOutput
from segslam.cli.viewers import check_display, scene_in, serve_foxglove
from segslam.core.errors import SegslamError, WorkFailed, counted
from segslam.core.extras import how_to_install
from segslam.core.interrupts import stopped_by_signals, when_stopped
from segslam.core.whole_files import expanded

if TYPE_CHECKING:
    from segslam.output.foxglove_server import FoxgloveServer
    from segslam.output.viewer import Scene
    from segslam.run.live.front import Front
    from segslam.run.live.live_map import Show
    from segslam.run.live.ros import MappingPublisher
    from segslam.run.live.serve import Placed
    from segslam.run.live.waiting import Source
    from segslam.run.run import Run

MOST_BEHIND = 20
"""Chosen: largest number of keyframes that wait for loop closing, 2 MB each. Further keyframes are stored, but their
loops are searched at the end of the run only."""

FINAL_SEARCH_S = 60.0
"""Chosen: the last search for loops ends after this time, so that the results of a live run are soon complete."""
LINE_EVERY_S, BAR_EVERY_S = 10.0, 0.2
MANY_DROPPED = 0.02
"""Chosen: share of dropped scans above which a faster odometry is recommended."""
COARSER = 1.5
"""Measured: KISS-ICP with voxels of 1.5 m takes 0.36 to 0.50 of the time that it takes with 1 m (docs/live.md)."""


def live(
    folder: Annotated[Path | None, "Folder into which a recorder writes scans (.bin .npy .ply .pcd)."] = None,
    *,
    out: Annotated[Path, "New folder for the run."],
    topic: Annotated[str | None, "ROS 2 topic of sensor_msgs/PointCloud2 messages, instead of a folder."] = None,
    idle: Annotated[
        float | None, typer.Option(min=0.1, metavar="SECONDS", help="End after this time without a new scan.")
    ] = None,
    labels: Annotated[str, "Labels: geometric (auto is the same) or none."] = "auto",
    preset: PresetOption = "auto",
    output: RunOutput,
    gnss: GnssOptions,
    terminal: Terminal,
) -> None:
    """Map scans while they arrive. Ctrl-C or SIGTERM finishes the run.

    Example: segslam live /data/scans --out runs/now --idle 10
    """
    if output.view:
        check_display()
    _check_source(folder, topic, gnss.gnss, out)
    output.load()  # reports a wrong setting before large libraries are loaded
    if labels not in ("auto", "geometric", "none"):
        raise SegslamError(f"--labels {labels}: live scans get geometric labels; give geometric or none")
    terminal.announce("live: starting")
    configs = live_configs(preset, output)
    from segslam.labels.label_files import unlabelled
    from segslam.run.live.front import Front
    from segslam.run.map_folder import in_effect
    from segslam.run.run import Run
    from segslam.slam.slam import Slam

    map_names, map_files = output.maps(out)
    check_free(outside(map_files, out), overwrite=output.overwrite)
    settings = configs["driving"]  # the presets differ in none of the values used here
    angle_deg = settings.sensor.vertical_angle_deg or 0.0
    source = _source(folder, topic, intensities=settings.map.color == "intensity", vertical_angle_deg=angle_deg)
    recorded = {"labels": labels, "live": source.name, "map_files": json_text.dumps([str(name) for name in map_names])}
    with ExitStack() as stack:
        scene = stack.enter_context(scene_in(None)) if output.view else None
        server = serve_foxglove(output.foxglove, stack, terminal)
        make_folder(out, overwrite=output.overwrite, inputs=[folder])
        stack.callback(remove_if_empty, out)
        terminal.compile_kernels()
        go_on = f"make the results from the log: segslam replay {shlex.quote(str(out))} --out NEW"
        when_stopped("no scan was mapped, nothing was written")
        place = gnss.placing_live(stack)
        front = stack.enter_context(Front(source, configs, tell=terminal.say, idle_s=idle))
        stack.enter_context(stopped_by_signals(front.stop))
        front.wait_until_ready()
        terminal.say(f"{source.name}: waiting for scans; Ctrl-C ends the run")
        if (chosen := front.wait_until_chosen()) is not None:
            settings = configs[chosen.preset]
            if preset == "auto":
                show_preset(chosen.preset, chosen.extent_m, terminal)
        settings = in_effect(settings, angle_deg)
        slam = Slam(settings, labeller=(lambda points: unlabelled(len(points))) if labels == "none" else None)
        mirror = server.send if server else None
        run = stack.enter_context(Run(out, slam, dataset=source.name, options=recorded, mirror=mirror))
        when_stopped(f"the log in {out} is kept; {go_on}")
        stack.enter_context(how_to_go_on(go_on, out))
        publisher = _publisher(run, stack) if folder is None else None
        figures = _follow(front, run, terminal, scene=scene, server=server, publisher=publisher)
        ended = front.ended
        if run.num_steps == 0:
            raise SegslamError(f"{source.name}: no scan was mapped{f' ({ended.why})' if ended.why else ''}")
        if ended.why and not ended.failed:
            terminal.say(f"{source.name}: {ended.why}")
        for file in map_files:
            file.parent.mkdir(parents=True, exist_ok=True)
        more = figures.metrics()
        finish(
            run,
            terminal,
            map_files=map_files,
            more=lambda _: more,
            search_s=FINAL_SEARCH_S,
            stopped=front.is_stopping,
            place=place,
        )
        if advice := too_slow(more, settings.odometry.voxel_size_m):
            terminal.say(advice)
    if ended.failed:
        raise WorkFailed(f"{ended.why}; the scans until then are mapped, results in {out}")


def _follow(
    front: "Front",
    run: "Run",
    terminal: Terminal,
    *,
    scene: "Scene | None",
    server: "FoxgloveServer | None",
    publisher: "MappingPublisher | None",
) -> "LiveFigures":
    """Close the loops of each scan with a pose, log it and pass it to all displays."""
    from segslam.core.types import Step
    from segslam.run.live.live_map import LiveMap

    figures = LiveFigures(front)
    shown = monotonic()
    shows: list[Show] = []
    if server:
        shows.append(lambda drawn: server.send_map(drawn.points, drawn.labels, drawn.stamp_ns))
    if publisher:
        shows.append(publisher.show_map)
    with LiveMap(shows) as live_map, _status(terminal) as (show, every_s):
        for placed in front:
            tries_loops = front.num_keyframes_waiting < MOST_BEHIND
            step = run.follow(placed.tracked, tries_loops=tries_loops)
            if scene:
                scene.add(step)
            if isinstance(step, Step):
                if publisher:
                    publisher.note_step(step)
                if step.keyframe:
                    is_corrected = step.estimate is not None
                    live_map.note(*run.map_so_far(), stamp_ns=step.stamp_ns, is_corrected=is_corrected)
            figures.note(placed, lag_s=monotonic() - placed.placed_s, tries_loops=tries_loops)
            if monotonic() - shown >= every_s:
                shown = monotonic()
                show(figures.line())
    return figures


def _check_source(folder: Path | None, topic: str | None, fixes: str | None, out: Path) -> None:
    """Raises SegslamError unless there is one source, and ROS 2 for topics; before large libraries are imported."""
    if (folder is None) == (topic is None):
        raise SegslamError(
            "give one source: a folder into which scans are written, as in segslam live /data/scans --out runs/now, "
            "or a ROS 2 topic, --topic /points"
        )
    if folder is not None:
        check_exists(folder, "give the folder into which scans are written")
        if not folder.is_dir():
            raise SegslamError(f"{folder}: not a folder; for a recording: segslam map {folder} --out {out}")
    if fixes is not None and expanded(fixes).is_file():
        raise SegslamError(
            f"--gnss {fixes}: a file, and live takes a ROS 2 topic, as in --gnss /fix; after the run: "
            f"segslam georeference {shlex.quote(str(out))} --gnss {shlex.quote(fixes)}"
        )
    for option, value in (("--topic", topic), ("--gnss", fixes)):
        if value is not None and find_spec("rclpy") is None:
            raise SegslamError(
                f"{option} needs ROS 2: source its setup script (Jazzy, Kilted), or: {how_to_install('ros')}"
            )


def _source(folder: Path | None, topic: str | None, *, intensities: bool, vertical_angle_deg: float) -> "Source":
    if folder is not None:
        from segslam.run.live.folder import FolderSource

        return FolderSource(folder, intensities=intensities, vertical_angle_deg=vertical_angle_deg)
    try:
        from segslam.run.live.ros import TopicSource
    except ImportError as error:
        raise SegslamError(
            f"--topic: ROS 2 cannot be loaded ({error}); source its setup script again, or: {how_to_install('ros')}"
        ) from error
    return TopicSource(topic or "", intensities=intensities, vertical_angle_deg=vertical_angle_deg)


def _publisher(run: "Run", stack: ExitStack) -> "MappingPublisher":
    """The publisher of path and map, for a topic; it also saves the map on request."""
    from segslam.run.live.live_map import save_map
    from segslam.run.live.ros import MappingPublisher

    def save() -> str:
        file = run.folder / "map_so_far.ply"
        T_world_keyframe, cloud = run.map_so_far()
        num_points = save_map(T_world_keyframe, cloud, file, config=run.config.map)
        return f"{file}: {num_points} points of {counted(len(T_world_keyframe), 'keyframe')}"

    return stack.enter_context(MappingPublisher(save))


class LiveFigures:
    """Latencies, delays and counts of a live run."""

    def __init__(self, front: "Front") -> None:
        self._front = front
        self._latency_ms: list[float] = []
        self._lag_s: list[float] = []
        self._num_unsearched = 0
        self._started = monotonic()

    def note(self, placed: "Placed", *, lag_s: float, tries_loops: bool) -> None:
        """Record a scan that was mapped and logged."""
        self._latency_ms.append(1000 * placed.latency_s)
        self._lag_s.append(lag_s)
        self._num_unsearched += placed.is_keyframe and not tries_loops

    def metrics(self) -> dict[str, Any]:
        """The figures of `metrics.json` that only live runs have."""
        tally = self._front.tally
        return {
            "num_scans_arrived": tally.num_arrived,
            "num_scans_dropped": tally.num_dropped,
            "num_scans_missing": tally.num_missing,
            "num_gaps": tally.num_gaps,
            "longest_gap_s": tally.longest_gap_s,
            "num_clock_set": tally.num_clock_set,
            "num_restarts": self._front.num_restarts,
            "num_keyframes_unsearched": self._num_unsearched,
            "latency_ms": _spread(self._latency_ms),
            "loop_lag_s": _spread(self._lag_s),
        }

    def line(self) -> str:
        """The status in one line."""
        num = len(self._lag_s)
        rate = num / max(monotonic() - self._started, 1e-9)
        text = f"live: {counted(num, 'scan')}, {rate:.1f}/s"
        if num:
            text += f", pose {median(self._latency_ms[-20:]):.0f} ms after the scan"
            if self._lag_s[-1] > 5.0:
                text += f", loops {self._lag_s[-1]:.1f} s behind"
        if num_dropped := self._front.tally.num_dropped:
            text += f", {num_dropped} dropped"
        if num_missing := self._front.tally.num_missing:
            text += f", {num_missing} missing"
        return text


def too_slow(metrics: Mapping[str, Any], voxel_size_m: float) -> str:
    """Advice after a run whose odometry dropped many scans; empty if it dropped few, or because a process died."""
    num_dropped, num_arrived = metrics["num_scans_dropped"], metrics["num_scans_arrived"]
    if num_dropped <= MANY_DROPPED * num_arrived or metrics.get("num_restarts"):
        return ""
    return (
        f"{num_dropped} of {num_arrived} scans were dropped because odometry took too long; "
        f"--set odometry.voxel_size_m={COARSER * voxel_size_m:g} takes about half the time"
    )


@contextmanager
def _status(terminal: Terminal) -> Iterator[tuple[Callable[[str], object], float]]:
    """Context manager that yields what shows the status, and how often (s): a line that changes, or further lines."""
    if terminal.quiet or not sys.stderr.isatty():
        yield terminal.say, LINE_EVERY_S
        return
    from rich.console import Console
    from rich.progress import Progress, SpinnerColumn, TextColumn

    columns = (SpinnerColumn(), TextColumn("{task.description}"))
    with Progress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task("live: no scan yet", total=None)
        yield lambda line: bar.update(task, description=line), BAR_EVERY_S


def _spread(values: list[float]) -> dict[str, float]:
    ordered = sorted(values)
    return {"median": median(ordered), "p95": ordered[int(0.95 * (len(ordered) - 1))], "max": ordered[-1]}
