"""`segslam register`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperCommand

from segslam.bench.experiments.method_settings import METHOD_NAMES, check_method
from segslam.cli.checks import check_exists
from segslam.cli.compiling import compile_kernels
from segslam.cli.completion import METHODS, labels_or_files, one_of
from segslam.cli.console import (
    ConfigOption,
    EncodingOption,
    JsonOption,
    QuietOption,
    SetOption,
    announce,
    print_json,
    print_out,
    say,
)

if TYPE_CHECKING:
    from segslam.bench.experiments.baselines import Estimate
    from segslam.core.config import Config
    from segslam.core.stopwatch import Stopwatch
    from segslam.core.types import Labels, Points, Rejected, ScanLabels

LABEL_WORDS = ("geometric", "none")


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


def register(
    source: Annotated[Path, typer.Argument(help="Scan to align: .bin, .npy, .ply or .pcd.")],
    target: Annotated[Path, typer.Argument(help="Fixed scan.")],
    dataset: Annotated[
        str | None,
        typer.Option(autocompletion=one_of("kitti"), help="kitti: apply KITTI's correction of the vertical angles."),
    ] = None,
    labels: Annotated[
        list[str] | None,
        typer.Option(
            autocompletion=labels_or_files,
            help="Labels: two .label files (source, target), geometric (default), network:MODEL.onnx, or none.",
        ),
    ] = None,
    encoding: EncodingOption = None,
    method: Annotated[
        str, typer.Option(autocompletion=METHODS, help=f"Method: {', '.join(METHOD_NAMES)}.")
    ] = "segregator-c2f",
    refine: Annotated[
        bool, typer.Option("--refine/--no-refine", help="Refine the coarse pose with GICP (method segregator-c2f).")
    ] = True,
    config: ConfigOption = None,
    settings: SetOption = None,
    json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Find the pose of one scan in another, without an initial guess. Exit status 1 if no pose is found.

    Example: segslam register 000000.bin 004413.bin --dataset kitti --labels 000000.label 004413.label
    """
    from segslam.core.config import load_config

    for scan in (source, target):
        check_exists(scan, "give two scan files")
    check_method(method)
    settings_now = load_config(config, settings or ())
    announce(f"register: reading {source} and {target}", quiet=quiet)
    from segslam.bench.experiments.methods import find_method, prepare_parts
    from segslam.core.stopwatch import Stopwatch

    if method == "segregator-c2f" and not refine:
        method = "segregator"
    chosen = find_method(method)
    compile_kernels(quiet=quiet)
    watch = Stopwatch()
    clouds = _read(source, target, dataset, labels, encoding, settings_now, watch)
    scans: list[dict[str, Any]] = []
    for name, (points, classes) in zip(("source", "target"), clouds, strict=True):
        with watch(f"describe_{name}"):
            parts = prepare_parts(points, classes, methods=[method], config=settings_now)
        scans.append({part: made.value for part, made in parts.items()})
    found = chosen.align(scans[0], scans[1], settings_now, watch)
    figures = _figures(found, watch)
    _show(figures, json=json, quiet=quiet)
    if not figures["accepted"]:
        say(f"rejected: {figures['reason']} ({figures['detail']})")
        raise typer.Exit(1)


def _read(
    source: Path,
    target: Path,
    dataset: str | None,
    labels: list[str] | None,
    encoding: Any,
    config: "Config",
    watch: "Stopwatch",
) -> list[tuple["Points", "Labels"]]:
    """Points and labels of the two scans."""
    from segslam.core.types import SegslamError
    from segslam.labels import geometric_labels
    from segslam.labels.label_files import encoding_of, open_labels, read_labels
    from segslam.labels.late import computed
    from segslam.scans.clouds import read_cloud, read_intensities
    from segslam.scans.dataset import make_scan
    from segslam.scans.kitti import VERTICAL_ANGLE_DEG

    if dataset not in (None, "kitti"):
        raise SegslamError(f"--dataset {dataset}: only kitti needs a correction; omit the option for other data")
    angle_deg = config.sensor.vertical_angle_deg
    if angle_deg is None:
        angle_deg = VERTICAL_ANGLE_DEG if dataset == "kitti" else 0.0
    stored = [read_cloud(file) for file in (source, target)]
    words = labels or ["geometric"]
    if len(words) == 2:
        files = [Path(word) for word in words]
        numbering = encoding or encoding_of(files)
        classes: list[ScanLabels] = [
            read_labels(file, len(points), numbering) for file, points in zip(files, stored, strict=True)
        ]
    elif _is_word(words[0]):
        labeller = open_labels(words[0], beside=source.parent, scan_names=(), encoding=None)
        classes = [
            labeller.read(file.stem, points, read_intensities(file))
            for file, points in zip((source, target), stored, strict=True)
        ]
    else:
        raise SegslamError(
            f"--labels {words[0]}: give two .label files, source and target, or geometric, or network:MODEL"
        )
    scans = [
        make_scan(file, 0, 0, points, ids, vertical_angle_deg=angle_deg)
        for file, points, ids in zip((source, target), stored, classes, strict=True)
    ]
    with watch("label"):
        return [
            (
                scan.points,
                geometric_labels(scan.points) if words[0] == "geometric" else computed(scan.labels),
            )
            for scan in scans
        ]


def _figures(found: "Estimate | Rejected", watch: "Stopwatch") -> dict[str, Any]:
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


def _show(figures: dict[str, Any], *, json: bool, quiet: bool) -> None:
    import numpy as np

    from segslam.core.types import probability_text

    if json:
        print_json(figures)
        return
    if not figures["accepted"]:
        return
    rows = np.array(figures["T_target_source"]).reshape(4, 4)
    print_out("\n".join(" ".join(f"{value:12.6f}" for value in row) for row in rows))
    overlap = "" if figures["overlap"] is None else f", overlap {figures['overlap']:.2f}"
    times = ", ".join(f"{stage} {1000 * seconds:.0f} ms" for stage, seconds in figures["seconds"].items())
    if figures["probability"] is not None:
        say(probability_text(figures["probability"], figures["evidence"]), quiet=quiet)
    inliers = "" if figures["num_inliers"] is None else f"{figures['num_inliers']} inliers{overlap}; "
    say(f"{inliers}{times}", quiet=quiet)
