"""`segslam locate` and `register`: poses of single scans, in a map or in another scan."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperCommand

from segslam.bench.experiments.method_settings import METHOD_NAMES, check_method
from segslam.cli.checks import check_exists
from segslam.cli.completion import labels_or_files
from segslam.cli.console import Terminal, print_json, say
from segslam.cli.options import EncodingOption, Settings
from segslam.core.errors import SegslamError

if TYPE_CHECKING:
    from segslam.bench.experiments.baselines import Estimate
    from segslam.core.config import Config
    from segslam.core.threads import Stopwatch
    from segslam.core.types import Labels, Points, Rejected, Scan, ScanLabels, Vector
    from segslam.run.locator import Located

    LabelsOf = Callable[[str, Points, Vector | None], ScanLabels]
    """Labels of a scan, given its name, points and intensities."""

LABEL_WORDS = ("geometric", "none")
NOT_FOUND: dict[str, Any] = {"found": False} | dict.fromkeys(
    ("T_world_lidar", "keyframe", "inliers", "overlap", "probability", "evidence", "reason", "detail")
)


@dataclass(frozen=True)
class ScanFileOptions:
    """What the scans of both commands have in common."""

    dataset: Annotated[
        str | None,
        typer.Option(autocompletion=lambda: ["kitti"], help="kitti: apply KITTI's correction of the vertical angles."),
    ] = None
    encoding: EncodingOption = None

    def check(self) -> None:
        """Raises SegslamError for an unknown kind of data."""
        if self.dataset not in (None, "kitti"):
            raise SegslamError(
                f"--dataset {self.dataset}: only kitti needs a correction; omit the option for other data"
            )

    def read(self, file: Path, labels_of: "LabelsOf", config: "Config") -> "Scan":
        """The usable points of a file, corrected, and their labels. Raises SegslamError, naming the file, if bad."""
        from segslam.scans.clouds import read_file
        from segslam.scans.dataset import make_scan
        from segslam.scans.kitti import VERTICAL_ANGLE_DEG

        cloud = read_file(file)
        labels = labels_of(file.stem, cloud.points, cloud.intensities)
        angle_deg = config.sensor.vertical_angle_deg
        if angle_deg is None:
            angle_deg = VERTICAL_ANGLE_DEG if self.dataset == "kitti" else 0.0
        return make_scan(file, 0, 0, cloud, labels, vertical_angle_deg=angle_deg)


class LabelsCommand(TyperCommand):
    """Accepts `--labels S T` as well as `--labels geometric`."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Repeat the option before its second value, because click accepts one value per option."""
        if "--labels" in args:
            second = args.index("--labels") + 2
            if second < len(args) and not _is_word(args[second - 1]) and not args[second].startswith("-"):
                args = [*args[:second], "--labels", *args[second:]]
        return super().parse_args(ctx, args)


def _is_word(label_source: str) -> bool:
    """True if the value is a labelling method for both scans, not a file."""
    return label_source in LABEL_WORDS or label_source.startswith("network:")


def locate(
    run: Annotated[Path, "Folder of a finished run, or its log.mcap."],
    scans: Annotated[list[Path], "Scans to locate: .bin, .npy, .ply or .pcd."],
    *,
    labels: Annotated[str, "Labels: geometric, none, or a folder of .label files named like the scans."] = "geometric",
    files: ScanFileOptions,
    terminal: Terminal,
) -> None:
    """Find the poses of single scans in a finished run, without an initial guess. Exit status 1 if none is found.

    `--json` prints a list with one object per scan.

    Example: segslam locate runs/00 004413.bin 000020.bin --dataset kitti
    """
    for scan in scans:
        check_exists(scan, "give scan files")
        if scan.is_dir():
            raise SegslamError(f"{scan}: is a folder; give scan files, or use segslam localise for a folder of scans")
    label_files = [] if labels in LABEL_WORDS else [Path(labels) / f"{scan.stem}.label" for scan in scans]
    for file in label_files:
        check_exists(file, "--labels: give geometric, none, or a folder with a .label file for each scan")
    terminal.announce(f"locate: reading {run}")
    from segslam.labels.label_files import LabelSource, computed, encoding_of, open_labels
    from segslam.run.locator import Locator

    files.check()
    if label_files:
        source = LabelSource(False, Path(labels), files.encoding or encoding_of(label_files))
    else:
        source = open_labels(labels, beside=Path(), scan_names=(), encoding=files.encoding)
    locator = Locator.from_run(run)
    terminal.compile_kernels()
    num_bad = 0
    found = []
    for scan in terminal.progress(scans, len(scans), "locate"):
        started = perf_counter()
        try:
            ready = files.read(scan, source.read, locator.config)
            classes = None if labels == "geometric" else computed(ready.labels)
        except SegslamError as error:
            num_bad += 1
            one = NOT_FOUND | {"reason": "unreadable", "detail": str(error)}
        else:
            started = perf_counter()
            one = _place(locator.locate(ready.points, classes))
        found.append(one | {"seconds": perf_counter() - started})
    if terminal.json:
        print_json(found)
    else:
        _show_places(scans, found, terminal)
    if num_bad:
        raise SegslamError(f"{num_bad} of {len(scans)} scans cannot be read (reasons above); repair or omit them")
    if not any(one["found"] for one in found):
        raise typer.Exit(1)


def register(
    source: Annotated[Path, "Scan to align: .bin, .npy, .ply or .pcd."],
    target: Annotated[Path, "Fixed scan."],
    *,
    labels: Annotated[
        list[str] | None,
        typer.Option(
            autocompletion=labels_or_files,
            help="Labels: two .label files (source, target), geometric (default), network:MODEL.onnx, or none.",
        ),
    ] = None,
    files: ScanFileOptions,
    method: Annotated[
        str, typer.Option(autocompletion=lambda: METHOD_NAMES, help=f"Method: {', '.join(METHOD_NAMES)}.")
    ] = "segregator-c2f",
    refine: Annotated[
        bool, typer.Option("--refine/--no-refine", help="Refine the coarse pose with GICP (method segregator-c2f).")
    ] = True,
    changes: Settings,
    terminal: Terminal,
) -> None:
    """Find the pose of one scan in another, without an initial guess. Exit status 1 if no pose is found.

    Example: segslam register 000000.bin 004413.bin --dataset kitti --labels 000000.label 004413.label
    """
    for scan in (source, target):
        check_exists(scan, "give two scan files")
    check_method(method)
    settings = changes.load()
    terminal.announce(f"register: reading {source} and {target}")
    from segslam.bench.experiments.methods import find_method, prepare_parts
    from segslam.core.threads import Stopwatch

    if method == "segregator-c2f" and not refine:
        method = "segregator"
    chosen = find_method(method)
    terminal.compile_kernels()
    watch = Stopwatch()
    clouds = _read_two(source, target, labels or ["geometric"], files, settings, watch)
    scans: list[dict[str, Any]] = []
    for name, (points, classes) in zip(("source", "target"), clouds, strict=True):
        with watch(f"describe_{name}"):
            scans.append(prepare_parts(points, classes, methods=[method], config=settings)[0])
    found = chosen.align(scans[0], scans[1], settings, watch)
    figures = _pose(found, watch)
    if terminal.json:
        print_json(figures)
    elif figures["accepted"]:
        _show_pose(figures, terminal)
    if not figures["accepted"]:
        say(f"rejected: {figures['reason']} ({figures['detail']})")
        raise typer.Exit(1)


def _read_two(
    source: Path, target: Path, words: list[str], files: ScanFileOptions, config: "Config", watch: "Stopwatch"
) -> list[tuple["Points", "Labels"]]:
    """Points and labels of the two scans."""
    from segslam.labels import geometric_labels
    from segslam.labels.label_files import computed, encoding_of, open_labels, read_labels

    files.check()
    both = (source, target)
    if len(words) == 2:
        label_files = [Path(word) for word in words]
        for file in label_files:
            check_exists(file, "give two .label files, source and target")
        numbering = files.encoding or encoding_of(label_files)

        def of_file(file: Path) -> "LabelsOf":
            return lambda _, points, __: read_labels(file, len(points), numbering)

        sources = [of_file(file) for file in label_files]
    elif _is_word(words[0]):
        of_both: LabelsOf = open_labels(words[0], beside=source.parent, scan_names=(), encoding=files.encoding).read
        sources = [of_both, of_both]
    else:
        raise SegslamError(
            f"--labels {words[0]}: give two .label files, source and target, or geometric, or network:MODEL"
        )
    scans = [files.read(file, labels_of, config) for file, labels_of in zip(both, sources, strict=True)]
    with watch("label"):
        return [
            (scan.points, geometric_labels(scan.points) if words[0] == "geometric" else computed(scan.labels))
            for scan in scans
        ]


def _place(found: "Located | Rejected") -> dict[str, Any]:
    from segslam.core.types import Rejected

    if isinstance(found, Rejected):
        judged = {"probability": found.probability, "evidence": found.evidence or None}
        return NOT_FOUND | judged | {"reason": found.reason.value, "detail": found.detail}
    return NOT_FOUND | {
        "found": True,
        "T_world_lidar": found.T_world_lidar.ravel().tolist(),
        "keyframe": found.keyframe_id,
        "inliers": found.inliers,
        "overlap": found.overlap,
        "probability": found.alignment.probability,
        "evidence": found.alignment.evidence,
    }


def _show_places(scans: list[Path], found: list[dict[str, Any]], terminal: Terminal) -> None:
    """Print file and pose of each scan on standard output, and details on standard error."""
    for scan, one in zip(scans, found, strict=True):
        if one["found"]:
            print(f"{scan} " + " ".join(f"{value:.6f}" for value in one["T_world_lidar"]), flush=True)
            terminal.say(
                f"{scan}: at keyframe {one['keyframe']}, {one['inliers']} inliers, overlap {one['overlap']:.2f}, "
                f"probability {one['probability']:.4f}, {1000 * one['seconds']:.0f} ms"
            )
        else:
            say(f"{scan}: not found: {one['reason']} ({one['detail']})")


def _pose(found: "Estimate | Rejected", watch: "Stopwatch") -> dict[str, Any]:
    from segslam.core.types import Rejected

    reason, detail, pose = None, None, None
    if isinstance(found, Rejected):
        reason, detail = found.reason.value, found.detail
    else:
        pose = found.T_target_source.ravel().tolist()
    names = ("probability", "evidence", "num_correspondences", "num_edges", "num_inliers", "overlap")
    shown = {key: getattr(found, key, None) for key in names}
    answer = {"accepted": reason is None, "reason": reason, "detail": detail, "T_target_source": pose}
    return answer | shown | {"seconds": watch.seconds}


def _show_pose(figures: dict[str, Any], terminal: Terminal) -> None:
    import numpy as np

    from segslam.core.types import probability_text

    rows = np.array(figures["T_target_source"]).reshape(4, 4)
    print("\n".join(" ".join(f"{value:12.6f}" for value in row) for row in rows), flush=True)
    overlap = "" if figures["overlap"] is None else f", overlap {figures['overlap']:.2f}"
    times = ", ".join(f"{stage} {1000 * seconds:.0f} ms" for stage, seconds in figures["seconds"].items())
    if figures["probability"] is not None:
        terminal.say(probability_text(figures["probability"], figures["evidence"]))
    inliers = "" if figures["num_inliers"] is None else f"{figures['num_inliers']} inliers{overlap}; "
    terminal.say(f"{inliers}{times}")
