"""All readers that damaged files are given to. A further reader is a further line in `targets`."""

import random
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any, get_args

import numpy as np

from fuzz import own_log, seeds
from fuzz.mutation import mutate
from fuzz.rewriting import rewritten
from segslam.core.config import load_config
from segslam.core.pose_files import read_poses
from segslam.core.types import BadScan, SegslamError
from segslam.gnss.reading import read_fixes
from segslam.graph.batch import Robust, optimize_graph
from segslam.graph.g2o import read_g2o
from segslam.labels.label_files import encoding_of, read_labels
from segslam.labels.network import Network
from segslam.labels.network_settings import read_settings
from segslam.output.log import read_log
from segslam.scans import open_dataset
from segslam.scans.clouds import read_file
from segslam.scans.dataset import make_scan, read_stamps
from segslam.scans.kitti import read_calibration
from segslam.scans.point_cloud2 import read_message

ROBUST = get_args(Robust)


@dataclass(frozen=True)
class Target:
    """A reader of one kind of file."""

    name: str
    file: Path
    """Where a content is written before `read` is called; other files that it needs are beside it."""
    seeds: list[bytes]
    """Valid contents."""
    read: Callable[[Path], Any]
    """Raises SegslamError, naming the file or its folder, for contents that cannot be used."""
    is_text: bool = False


def targets(folder: Path) -> list[Target]:
    """All readers, with their files in a folder of their own."""

    def at(name: str) -> Path:
        made = folder / name.replace("/", "-")
        made.mkdir(parents=True, exist_ok=True)
        return made

    packets, metadata = seeds.pcap(at("pcap"))
    seeds.pcap(at("ouster-json"))
    model, settings = seeds.network(at("onnx"))
    database = seeds.bag2(at("bag2"))
    described = seeds.bag2(at("bag2-metadata"))
    for name in ("classes", "settings"):
        (at(name) / "arch_cfg.yaml").write_bytes(seeds.ARCHITECTURE)
    (at("settings") / "data_cfg.yaml").write_bytes(seeds.CLASS_MAP)
    (at("messages") / "whole.mcap").write_bytes(seeds.mcap(at("seed"), 2**20))
    whole_log = own_log.write_whole(at("whole") / "log.mcap")
    stored = next(database.glob("*.db3"))
    return [
        Target("bin", at("bin") / "0.bin", [seeds.rows(seeds.ROW, num).tobytes() for num in (40, 1000)], _scan),
        Target("npy", at("npy") / "0.npy", [seeds.npy(np.ones((40, k))) for k in (3, 4)], _scan, is_text=True),
        Target("ply", at("ply") / "0.ply", seeds.plys(), _scan, is_text=True),
        Target("pcd", at("pcd") / "0.pcd", seeds.pcds(), _scan, is_text=True),
        Target("point_cloud2", at("point_cloud2") / "seed", [bytes(8)], _message),
        Target("mcap", at("mcap") / "a.mcap", [seeds.mcap(at("seed"), size) for size in (2**20, 1)], _recording),
        Target("mcap messages", at("messages") / "seed", [bytes(8)], _mcap_messages),
        Target("bag1", at("bag1") / "a.bag", [seeds.bag1(at("seed"))], _recording),
        Target("bag2", stored, [stored.read_bytes()], lambda file: _recording(file.parent)),
        Target(
            "bag2 metadata",
            described / "metadata.yaml",
            [(described / "metadata.yaml").read_bytes()],
            lambda file: _recording(file.parent),
            is_text=True,
        ),
        Target("pcap", at("pcap") / "drive.pcap", [packets], _recording),
        Target(
            "ouster json",
            at("ouster-json") / "drive.json",
            [metadata],
            lambda file: _recording(file.with_suffix(".pcap")),
            is_text=True,
        ),
        Target("poses", at("poses") / "p.txt", [seeds.KITTI_POSES, seeds.TUM_POSES], read_poses, is_text=True),
        Target("times", at("times") / "times.txt", [seeds.TIMES], read_stamps, is_text=True),
        Target("calib", at("calib") / "calib.txt", [seeds.CALIB], read_calibration, is_text=True),
        Target("gnss", at("gnss") / "fixes.txt", list(seeds.FIXES), read_fixes, is_text=True),
        Target("g2o", at("g2o") / "a.g2o", [seeds.G2O + b"\n" * k for k in range(len(ROBUST))], _graph, is_text=True),
        Target("config", at("config") / "a.yaml", [seeds.CONFIG], load_config, is_text=True),
        Target("set", at("set") / "text", list(seeds.OVERRIDES), _override, is_text=True),
        Target("log", at("log") / "log.mcap", [whole_log.read_bytes()], _log(whole_log)),
        Target("log messages", at("log messages") / "seed", [bytes(8)], _log_messages(whole_log)),
        Target("labels", at("labels") / "0.label", [seeds.labels()], _labels),
        Target(
            "settings",
            at("settings") / "net.yaml",
            [seeds.SETTINGS, seeds.ARCHITECTURE, b"import: arch_cfg.yaml\nclasses: [car, road]\n"],
            read_settings,
            is_text=True,
        ),
        Target(
            "classes",
            at("classes") / "data_cfg.yaml",
            [seeds.CLASS_MAP],
            lambda file: read_settings(file.with_name("arch_cfg.yaml")),
            is_text=True,
        ),
        Target("onnx", at("onnx") / "net.onnx", [model], _network),
        Target("onnx settings", at("onnx") / "net.yaml", [settings], _network_settings(model), is_text=True),
    ]


def _scan(file: Path) -> None:
    cloud = read_file(file)
    make_scan(file, 0, 0, cloud, np.zeros(len(cloud.points), np.uint8), has_intensities=True)


def _recording(data: Path) -> None:
    dataset = open_dataset(data, topic="/lidar/points" if data.suffix != ".pcap" else "", intensities=True)
    for row in range(min(len(dataset), 10)):
        try:
            dataset[row]
        except BadScan as error:
            if str(data.parent) not in str(error):
                raise AssertionError(f"not named: {error}") from error


def _message(file: Path) -> None:
    """A message whose numbers follow from the bytes of the file."""
    rng = random.Random(file.read_bytes())
    numbers = (0, 1, 4, 16, 20, 600, -1, 2**31 - 1, 2**32 - 1, 10**9)
    values = seeds.message(seeds.rows(seeds.ROW))
    for name in ("height", "width", "point_step", "row_step"):
        if rng.random() < 0.15:
            values[name] = rng.choice(numbers)
    for field in values["fields"]:
        if rng.random() < 0.1:
            field["datatype"] = rng.choice((1, 8, 0, 9, 255))
        if rng.random() < 0.1:
            field["offset"] = rng.choice(numbers)
        if rng.random() < 0.1:
            field["name"] = rng.choice(("", "x", "time", "\0"))
    values["data"] = values["data"][: rng.choice((None, None, 639, 10, 0))]
    fields = [SimpleNamespace(**field) for field in values.pop("fields")]
    header = SimpleNamespace(stamp=SimpleNamespace(sec=1, nanosec=5))
    with suppress(KeyError, TypeError, ValueError):  # which the reader documents; its callers name the source
        read_message(SimpleNamespace(header=header, fields=fields, **values))


def _mcap_messages(file: Path) -> None:
    """A recording with valid checksums whose second message is damaged, as the bytes of the file determine."""
    rng = random.Random(file.read_bytes())
    recording = file.with_name("a.mcap")
    whole = file.with_name("whole.mcap").read_bytes()
    recording.write_bytes(rewritten(whole, lambda data: mutate(rng, data[:260], is_text=False) + data[260:]))
    _recording(recording)


def _graph(file: Path) -> None:
    graph = read_g2o(file)
    with suppress(SegslamError):  # the command names the file
        optimize_graph(graph, robust=ROBUST[file.stat().st_size % len(ROBUST)])


def _override(file: Path) -> None:
    """The text of `--set`, which an error has to quote."""
    text = file.read_bytes().decode("utf-8", "surrogateescape")
    try:
        load_config(None, [text])
    except SegslamError as error:
        if "--set" not in str(error) or len(str(error)) > 1000:
            raise AssertionError(str(error)[:200]) from error


def _log(whole: Path) -> Callable[[Path], None]:
    all_of_it = cache(lambda: own_log.Read(read_log(whole)))  # read once, before there are children

    def read(file: Path) -> None:
        own_log.Read(read_log(file)).check_part_of(all_of_it())

    return read


def _log_messages(whole: Path) -> Callable[[Path], None]:
    """A log with valid checksums and odd content, as the bytes of the file determine."""

    def read(file: Path) -> None:
        log = file.with_name("log.mcap")
        log.write_bytes(own_log.odd(random.Random(file.read_bytes()), whole))
        own_log.Read(read_log(log))

    return read


def _labels(file: Path) -> None:
    read_labels(file, file.stat().st_size // 4, encoding_of([file] * 3))


def _network(file: Path) -> None:
    network = Network(file)
    network.labels(np.random.default_rng(0).uniform(-20, 20, (50, 3)), np.ones(50))


def _network_settings(model: bytes) -> Callable[[Path], None]:
    def read(file: Path) -> None:
        file.with_suffix(".onnx").write_bytes(model)
        _network(file.with_suffix(".onnx"))

    return read
