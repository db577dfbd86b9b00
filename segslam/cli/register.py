"""`segslam register`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperCommand

from segslam.cli.console import (
    ConfigOption,
    EncodingOption,
    JsonOption,
    QuietOption,
    SetOption,
    print_json,
    say,
)
from segslam.experiments.settings import METHOD_NAMES

if TYPE_CHECKING:
    from segslam.alignment import Stopwatch
    from segslam.config import Config
    from segslam.experiments.estimate import Estimate
    from segslam.types import Labels, Points, Rejected

LABEL_WORDS = ("geometric", "none")


class LabelsCommand(TyperCommand):
    """Takes `--labels S T` as well as `--labels geometric`."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Repeat the option before its second value, which is how click takes two."""
        if "--labels" in args:
            second = args.index("--labels") + 2
            if second < len(args) and not _is_word(args[second - 1]):
                args = [*args[:second], "--labels", *args[second:]]
        return super().parse_args(ctx, args)


def _is_word(label_source: str) -> bool:
    """Whether it labels both scans, as no file does."""
    return label_source in LABEL_WORDS or label_source.startswith("network:")


def register(
    source: Annotated[Path, typer.Argument(help="Scan that is moved: .bin, .npy, .ply or .pcd.")],
    target: Annotated[Path, typer.Argument(help="Scan that stays.")],
    dataset: Annotated[str | None, typer.Option(help="kitti: apply KITTI's vertical-angle correction.")] = None,
    labels: Annotated[
        list[str] | None,
        typer.Option(help="Two .label files, source's and target's; geometric (default); network:MODEL.onnx; none."),
    ] = None,
    encoding: EncodingOption = None,
    method: Annotated[str, typer.Option(help=f"One of {', '.join(METHOD_NAMES)}.")] = "segregator-c2f",
    refine: Annotated[
        bool, typer.Option("--refine/--no-refine", help="Of segregator-c2f: sharpen the coarse pose by ICP.")
    ] = True,
    config: ConfigOption = None,
    settings: SetOption = None,
    json: JsonOption = False,
    quiet: QuietOption = False,
) -> None:
    """Align two scans with no initial guess.

    Example: segslam register 000000.bin 004413.bin --dataset kitti --labels 000000.label 004413.label
    """
    from segslam.alignment import Stopwatch
    from segslam.config import load_config
    from segslam.experiments.methods import find_method, prepare

    if method == "segregator-c2f" and not refine:
        method = "segregator"
    chosen = find_method(method)
    settings_now = load_config(config, settings or ())
    clouds = _read(source, target, dataset, labels, encoding, settings_now)
    watch = Stopwatch()
    scans: list[dict[str, Any]] = []
    for name, (points, classes) in zip(("source", "target"), clouds, strict=True):
        with watch(f"describe_{name}"):
            parts = prepare(points, classes, methods=[method], config=settings_now)
        scans.append({part: made.value for part, made in parts.items()})
    found = chosen.align(scans[0], scans[1], settings_now, watch)
    _show(_figures(found, watch), json=json, quiet=quiet)


def _read(
    source: Path,
    target: Path,
    dataset: str | None,
    labels: list[str] | None,
    encoding: Any,
    config: "Config",
) -> list[tuple["Points", "Labels"]]:
    """The two scans with their labels, in step."""
    from segslam.alignment import shape_labels
    from segslam.datasets.clouds import read_cloud, read_intensities
    from segslam.datasets.kitti import correct_vertical_angle
    from segslam.datasets.scans import make_scan
    from segslam.semantics.label_files import encoding_of, open_labels, read_labels
    from segslam.types import SegslamError

    if dataset not in (None, "kitti"):
        raise SegslamError(f"--dataset {dataset}: only kitti needs a correction; leave the option out")
    stored = [read_cloud(file) for file in (source, target)]
    words = labels or ["geometric"]
    if len(words) == 2:
        files = [Path(word) for word in words]
        numbering = encoding or encoding_of(files)
        classes = [read_labels(file, len(points), numbering) for file, points in zip(files, stored, strict=True)]
    elif _is_word(words[0]):
        labeller = open_labels(words[0], beside=source.parent, scan_names=(), encoding=None)
        classes = [
            labeller.read(file.stem, points, read_intensities(file))
            for file, points in zip((source, target), stored, strict=True)
        ]
    else:
        raise SegslamError(
            f"--labels {words[0]}: give two .label files, the source's and the target's, or geometric, or network:MODEL"
        )
    corrected = [correct_vertical_angle(points) if dataset == "kitti" else points for points in stored]
    scans = [
        make_scan(file, 0, 0, points, ids)
        for file, points, ids in zip((source, target), corrected, classes, strict=True)
    ]
    return [
        (scan.points, shape_labels(scan.points, config=config) if words[0] == "geometric" else scan.labels)
        for scan in scans
    ]


def _figures(found: "Estimate | Rejected", watch: "Stopwatch") -> dict[str, Any]:
    from segslam.types import Rejected

    reason, detail, pose = None, None, None
    if isinstance(found, Rejected):
        reason, detail = found.reason.value, found.detail
    else:
        pose = found.T_target_source.ravel().tolist()
    told = {key: getattr(found, key, None) for key in ("num_correspondences", "num_edges", "num_inliers", "overlap")}
    answer = {"accepted": reason is None, "reason": reason, "detail": detail, "T_target_source": pose}
    return answer | told | {"seconds": watch.seconds}


def _show(figures: dict[str, Any], *, json: bool, quiet: bool) -> None:
    import numpy as np

    if json:
        print_json(figures)
        return
    if not figures["accepted"]:
        say(f"rejected: {figures['reason']} ({figures['detail']})", quiet=quiet)
        return
    rows = np.array(figures["T_target_source"]).reshape(4, 4)
    print("\n".join(" ".join(f"{value:12.6f}" for value in row) for row in rows))
    overlap = "" if figures["overlap"] is None else f", overlap {figures['overlap']:.2f}"
    times = ", ".join(f"{stage} {1000 * seconds:.0f} ms" for stage, seconds in figures["seconds"].items())
    inliers = "" if figures["num_inliers"] is None else f"{figures['num_inliers']} inliers{overlap}; "
    say(f"{inliers}{times}", quiet=quiet)
