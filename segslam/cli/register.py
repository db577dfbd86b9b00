"""`segslam register`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperCommand

from segslam.cli.console import ConfigOption, EncodingOption, JsonOption, SetOption, print_json, say

if TYPE_CHECKING:
    from segslam.alignment import PreparedScan, Stopwatch
    from segslam.config import Config
    from segslam.types import Alignment, Labels, Points, Registration, Rejected

FPFH_ONLY = {
    "gate": "lengths",
    "features": "always",
    "cluster_min_points": {},
    "feature_voxel_m": 0.5,
    "normal_radius_m": 1.0,
    "feature_radius_m": 2.5,
}
"""Point features alone, as Segregator's authors compute them."""
METHODS: dict[str, dict[str, Any]] = {
    "segregator": {},
    "segregator-c2f": {},
    "segator": {"gate": "lengths"},
    "teaser": FPFH_ONLY,
    "quatro": FPFH_ONLY | {"rotation": "yaw"},
}
"""Settings of section `segregator` that make the methods of the paper's tables."""
LABEL_WORDS = ("geometric", "none")


class LabelsCommand(TyperCommand):
    """Takes `--labels S T` as well as `--labels geometric`."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Repeat the option before its second value, which is how click takes two."""
        if "--labels" in args:
            second = args.index("--labels") + 2
            if args[second - 1 : second] and args[second - 1] not in LABEL_WORDS and second < len(args):
                args = [*args[:second], "--labels", *args[second:]]
        return super().parse_args(ctx, args)


def register(
    source: Annotated[Path, typer.Argument(help="Scan that is moved: .bin, .npy, .ply or .pcd.")],
    target: Annotated[Path, typer.Argument(help="Scan that stays.")],
    dataset: Annotated[str | None, typer.Option(help="kitti: apply KITTI's vertical-angle correction.")] = None,
    labels: Annotated[
        list[str] | None, typer.Option(help="Two .label files, source's and target's; or geometric (default), or none.")
    ] = None,
    encoding: EncodingOption = None,
    method: Annotated[str, typer.Option(help=f"One of {', '.join(METHODS)}.")] = "segregator-c2f",
    refine: Annotated[bool, typer.Option("--refine/--no-refine", help="Sharpen the coarse pose by ICP.")] = True,
    config: ConfigOption = None,
    settings: SetOption = None,
    json: JsonOption = False,
) -> None:
    """Align two scans with no initial guess.

    Example: segslam register 000000.bin 004413.bin --dataset kitti --labels 000000.label 004413.label
    """
    from segslam import segregator
    from segslam.alignment import Stopwatch, align, prepare_scan

    settings_now = _settings(method, config, settings)
    clouds = _read(source, target, dataset, labels, encoding, settings_now)
    watch = Stopwatch()
    scans: list[PreparedScan] = []
    for name, (points, classes) in zip(("source", "target"), clouds, strict=True):
        with watch(f"describe_{name}"):
            scans.append(prepare_scan(points, classes, config=settings_now))
    if refine and method != "segregator":
        found: Alignment | Registration | Rejected = align(*scans, config=settings_now, watch=watch)
    else:
        with watch("match"):
            found = segregator.match(*(scan.description for scan in scans), config=settings_now.segregator)
    _show(_figures(found, watch), json=json)


def _settings(method: str, config: Path | None, settings: list[str] | None) -> "Config":
    from segslam.config import load_config
    from segslam.types import SegslamError

    if method not in METHODS:
        raise SegslamError(f"--method {method}: no such method; known: {', '.join(METHODS)}")
    chosen = load_config(config, settings or ())
    return chosen.model_copy(update={"segregator": chosen.segregator.model_copy(update=METHODS[method])})


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
    from segslam.datasets.clouds import read_cloud
    from segslam.datasets.kitti import correct_vertical_angle
    from segslam.datasets.scans import make_scan
    from segslam.semantics.label_files import encoding_of, read_labels, unlabelled
    from segslam.types import SegslamError

    if dataset not in (None, "kitti"):
        raise SegslamError(f"--dataset {dataset}: only kitti needs a correction; leave the option out")
    stored = [read_cloud(file) for file in (source, target)]
    words = labels or ["geometric"]
    if len(words) == 2:
        files = [Path(word) for word in words]
        numbering = encoding or encoding_of(files)
        classes = [read_labels(file, len(points), numbering) for file, points in zip(files, stored, strict=True)]
    elif words[0] in LABEL_WORDS:
        classes = [unlabelled(len(points)) for points in stored]
    else:
        raise SegslamError(f"--labels {words[0]}: give two .label files, the source's and the target's, or geometric")
    corrected = [correct_vertical_angle(points) if dataset == "kitti" else points for points in stored]
    scans = [
        make_scan(file, 0, 0, points, ids)
        for file, points, ids in zip((source, target), corrected, classes, strict=True)
    ]
    return [
        (scan.points, shape_labels(scan.points, config=config) if words[0] == "geometric" else scan.labels)
        for scan in scans
    ]


def _figures(found: "Alignment | Registration | Rejected", watch: "Stopwatch") -> dict[str, Any]:
    from segslam.types import Alignment, Rejected

    figures: dict[str, Any] = {
        "accepted": not isinstance(found, Rejected),
        "reason": None,
        "detail": None,
        "T_target_source": None,
        "num_correspondences": None,
        "num_edges": None,
        "num_inliers": None,
        "overlap": None,
    }
    if isinstance(found, Rejected):
        figures |= {"reason": found.reason.value, "detail": found.detail}
    else:
        coarse, fine = (found.coarse, found.fine) if isinstance(found, Alignment) else (found, found)
        figures |= {
            "T_target_source": fine.T_target_source.ravel().tolist(),
            "num_correspondences": coarse.num_correspondences,
            "num_edges": coarse.num_edges,
            "num_inliers": coarse.num_inliers,
            "overlap": found.overlap if isinstance(found, Alignment) else None,
        }
    return figures | {"seconds": watch.seconds}


def _show(figures: dict[str, Any], *, json: bool) -> None:
    import numpy as np

    if json:
        print_json(figures)
        return
    if not figures["accepted"]:
        say(f"rejected: {figures['reason']} ({figures['detail']})")
        return
    rows = np.array(figures["T_target_source"]).reshape(4, 4)
    print("\n".join(" ".join(f"{value:12.6f}" for value in row) for row in rows))
    overlap = "" if figures["overlap"] is None else f", overlap {figures['overlap']:.2f}"
    times = ", ".join(f"{stage} {1000 * seconds:.0f} ms" for stage, seconds in figures["seconds"].items())
    say(f"{figures['num_inliers']} of {figures['num_correspondences']} correspondences{overlap}; {times}")
