"""`segslam live`."""

import json as json_text
import shlex
from collections.abc import Callable
from contextlib import ExitStack
from importlib.util import find_spec
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING, Annotated, Any

import typer

from segslam.cli.checks import check_exists
from segslam.cli.compiling import compile_kernels
from segslam.cli.console import announce, how_to_go_on, say
from segslam.cli.ending import finish
from segslam.cli.foxglove import serve_foxglove
from segslam.cli.gnss_options import GnssOptions
from segslam.cli.live_status import LiveFigures, Status, too_slow
from segslam.cli.overwriting import check_free, make_room
from segslam.cli.preset import live_config
from segslam.cli.run_options import OutputOptions, PresetOption
from segslam.cli.shared_options import with_options
from segslam.cli.view import check_display, close_scene, open_scene
from segslam.core.errors import SegslamError, WorkFailed
from segslam.core.extras import how_to_install
from segslam.core.interrupts import stopped_by_signals, when_stopped

if TYPE_CHECKING:
    from segslam.core.config import Config
    from segslam.core.types import BadScan, Step
    from segslam.output.foxglove_server import FoxgloveServer
    from segslam.output.viewer import Scene
    from segslam.registration.prepared import Labeller
    from segslam.run.live import Front, LiveMap, Source
    from segslam.run.live.live_map import Show
    from segslam.run.live.ros import MappingPublisher
    from segslam.run.run import Run

MOST_BEHIND = 20
"""Chosen: largest number of keyframes that wait for loop closing, 2 MB each. Further keyframes are stored, but their
loops are searched at the end of the run only."""

MAP_SO_FAR = "map_so_far.ply"
"""Written by the service `/segslam/save_map`."""
FINAL_SEARCH_S = 60.0
"""Chosen: the last search for loops ends after this time, so that the results of a live run are soon complete."""


@with_options
def live(
    out: Annotated[Path, typer.Option(help="New folder for the run.")],
    *,
    folder: Annotated[
        Path | None, typer.Argument(help="Folder into which a recorder writes scans (.bin .npy .ply .pcd).")
    ] = None,
    topic: Annotated[
        str | None, typer.Option(help="ROS 2 topic of sensor_msgs/PointCloud2 messages, instead of a folder.")
    ] = None,
    idle: Annotated[
        float | None, typer.Option(min=0.1, metavar="SECONDS", help="End after this time without a new scan.")
    ] = None,
    labels: Annotated[str, typer.Option("--labels", help="Labels: geometric (auto is the same) or none.")] = "auto",
    preset: PresetOption = "auto",
    options: OutputOptions,
    gnss: GnssOptions,
) -> None:
    """Map scans while they arrive. Ctrl-C or SIGTERM finishes the run.

    Example: segslam live /data/scans --out runs/now --idle 10
    """
    quiet = options.quiet
    if options.view:
        check_display()
    _check_source(folder, topic, out)
    if gnss.gnss is not None:
        _check_ros("--gnss")
    options.load_config()  # reports a wrong setting before the scans are looked at
    if labels not in ("auto", "geometric", "none"):
        raise SegslamError(f"--labels {labels}: live scans get geometric labels; give geometric or none")
    announce("live: starting", quiet=quiet)
    settings = options.load_config(base=live_config(preset, folder, topic, quiet=quiet))
    from segslam.output.folder import new_folder

    map_names, map_files = options.maps(out)
    check_free([file for file in map_files if out not in file.parents], overwrite=options.overwrite)
    angle_deg = settings.sensor.vertical_angle_deg or 0.0
    sensor = settings.sensor.model_copy(update={"vertical_angle_deg": angle_deg})
    settings = settings.model_copy(update={"sensor": sensor})
    source = _source(folder, topic, intensities=settings.map.color == "intensity", vertical_angle_deg=angle_deg)
    scene = open_scene(None, view_every=settings.log.view_every) if options.view else None
    with ExitStack() as stack:
        server = serve_foxglove(options.foxglove, stack, quiet=quiet)
        make_room(out, overwrite=options.overwrite, inputs=[folder] if folder else [])
        out = new_folder(out)
        compile_kernels(quiet=quiet)
        recorded = {
            "labels": labels,
            "live": source.name,
            "map_files": json_text.dumps([str(name) for name in map_names]),
        }
        why = map_live(
            source,
            out,
            settings=settings,
            labeller=_unlabelled() if labels == "none" else None,
            options=recorded,
            idle_s=idle,
            map_files=map_files,
            scene=scene,
            server=server,
            gnss=gnss,
            json=options.json,
            quiet=quiet,
        )
    if scene:
        close_scene(scene, None)
    if why:
        raise WorkFailed(f"{why}; the scans until then are mapped, results in {out}")


def map_live(
    source: "Source",
    folder: Path,
    *,
    settings: "Config",
    labeller: "Labeller | None",
    options: dict[str, str],
    idle_s: float | None,
    map_files: list[Path],
    scene: "Scene | None",
    server: "FoxgloveServer | None",
    gnss: GnssOptions,
    json: bool,
    quiet: bool,
) -> str:
    """Map the scans of a source into a new folder until it ends. Returns the reason if it failed, otherwise "".

    Raises SegslamError if the source cannot be opened or no scan arrived; the folder is then removed.
    """
    from segslam.run.live import Front, LiveMap
    from segslam.run.run import Run
    from segslam.slam.slam import Slam

    go_on = f"make the results from the log: segslam replay {shlex.quote(str(folder))} --out NEW"
    when_stopped(f"the log in {folder} is kept; {go_on}")
    slam = Slam(settings, labeller=labeller)

    def tell(text: str) -> None:
        say(text, quiet=quiet)

    with how_to_go_on(go_on), ExitStack() as stack:
        mirror = server.send if server else None
        run = stack.enter_context(Run(folder, slam, dataset=source.name, options=options, mirror=mirror))
        publisher = _publisher(source, run, stack)
        place = gnss.placing_live(stack)
        front = stack.enter_context(Front(source, settings, tell=tell, idle_s=idle_s))
        stops: list[bool] = []

        def stop() -> None:
            stops.append(True)
            front.stop()

        stack.enter_context(stopped_by_signals(stop))
        front.wait_until_ready()
        tell(f"{source.name}: waiting for scans; Ctrl-C ends the run")
        shows = _shows(server, publisher)
        with LiveMap(shows, view_every=settings.log.view_every) as live_map:
            watch = _watch(run, scene, live_map, publisher)
            figures = _follow(front, run, watch, quiet=quiet)
        ended = front.ended
        if run.num_steps == 0:
            raise SegslamError(f"{source.name}: no scan was mapped{f' ({ended.why})' if ended.why else ''}")
        if ended.why and not ended.failed:
            say(f"{source.name}: {ended.why}", quiet=quiet)
        for file in map_files:
            file.parent.mkdir(parents=True, exist_ok=True)

        more = figures.metrics(ended, num_restarts=front.num_restarts)
        finish(
            run,
            None,
            map_files=map_files,
            json=json,
            quiet=quiet,
            more=lambda _: more,
            search_s=FINAL_SEARCH_S,
            stopped=bool(stops),
            place=place,
        )
        if advice := too_slow(more, settings.odometry.voxel_size_m):
            say(advice, quiet=quiet)
    return ended.why if ended.failed else ""


def _follow(front: "Front", run: "Run", watch: "Callable[[Step | BadScan], None]", *, quiet: bool) -> LiveFigures:
    """Close the loops of each scan with a pose, log it and show it."""
    figures = LiveFigures()
    with Status(quiet=quiet) as status:
        for placed in front:
            tries_loops = front.num_keyframes_waiting < MOST_BEHIND
            watch(run.follow(placed.tracked, tries_loops=tries_loops))
            figures.note(placed, lag_s=monotonic() - placed.placed_s, tries_loops=tries_loops)
            status.show(figures)
    return figures


def _watch(
    run: "Run", scene: "Scene | None", live_map: "LiveMap", publisher: "MappingPublisher | None"
) -> "Callable[[Step | BadScan], None]":
    """A function that passes each step to all displays."""
    from segslam.core.types import Step

    def watch(step: "Step | BadScan") -> None:
        if scene:
            scene.add(step)
        if not isinstance(step, Step):
            return
        keyframe = step.keyframe
        if publisher:
            publisher.note_step(step.stamp_ns, keyframe.T_odom_keyframe if keyframe else None, step.estimate)
        if keyframe:
            live_map.note(*run.map_so_far(), stamp_ns=step.stamp_ns, is_corrected=step.estimate is not None)

    return watch


def _shows(server: "FoxgloveServer | None", publisher: "MappingPublisher | None") -> "list[Show]":
    """Functions that display an updated map."""
    shows: list[Show] = []
    if server:
        shows.append(lambda drawn: server.send_map(drawn.points, drawn.labels, drawn.stamp_ns))
    if publisher:
        shows.append(publisher.show_map)
    return shows


def _check_source(folder: Path | None, topic: str | None, out: Path) -> None:
    """Raises SegslamError unless exactly one source is given; called before large libraries are imported."""
    if (folder is None) == (topic is None):
        raise SegslamError(
            "give one source: a folder into which scans are written, as in segslam live /data/scans --out runs/now, "
            "or a ROS 2 topic, --topic /points"
        )
    if folder is not None:
        check_exists(folder, "give the folder into which scans are written")
        if not folder.is_dir():
            raise SegslamError(f"{folder}: not a folder; for a recording: segslam map {folder} --out {out}")
    else:
        _check_ros("--topic")


def _check_ros(option: str) -> None:
    if find_spec("rclpy") is None:
        raise SegslamError(
            f"{option} needs ROS 2: source its setup script (Jazzy, Kilted), or: {how_to_install('ros')}"
        )


def _source(folder: Path | None, topic: str | None, *, intensities: bool, vertical_angle_deg: float) -> "Source":
    if folder is not None:
        from segslam.run.live import FolderSource

        return FolderSource(folder, intensities=intensities, vertical_angle_deg=vertical_angle_deg)
    try:
        from segslam.run.live.ros import TopicSource
    except ImportError as error:
        raise SegslamError(
            f"--topic: ROS 2 cannot be loaded ({error}); source its setup script again, or: {how_to_install('ros')}"
        ) from error
    return TopicSource(topic or "", intensities=intensities, vertical_angle_deg=vertical_angle_deg)


def _publisher(source: "Source", run: "Run", stack: ExitStack) -> "MappingPublisher | None":
    """The publisher of path and map if the source is a topic; it also saves the map on request."""
    from segslam.run.live import FolderSource
    from segslam.run.live.saved_map import save_map

    if isinstance(source, FolderSource):
        return None
    from segslam.run.live.ros import MappingPublisher

    def save() -> str:
        file = run.folder / MAP_SO_FAR
        made = save_map(*run.map_so_far(), file, config=run.config.map)
        return f"{file}: {made.num_points} points of {made.num_keyframes} keyframe{'s' * (made.num_keyframes != 1)}"

    return stack.enter_context(MappingPublisher(save))


def _unlabelled() -> "Labeller":
    from segslam.labels.label_files import unlabelled

    def labeller(points: Any) -> Any:
        return unlabelled(len(points))

    return labeller
