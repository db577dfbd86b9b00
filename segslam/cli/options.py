"""Options that several commands share. `with_options` makes an option of each field of a record of options."""

import inspect
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, fields, is_dataclass
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args

import typer
from typer.models import OptionInfo

from segslam.cli import completion
from segslam.core.errors import SegslamError

if TYPE_CHECKING:
    from segslam.core.config import Config
    from segslam.scans import DataSource

WITH_MAP = ("map.ply", "map.png")
"""Files that `--map` writes into the run folder."""

VALUE_NAMES: dict[Any, str] = {Path: "PATH", str: "TEXT", int: "N", float: "NUMBER"}
GNSS_USES = ("fuse", "align")
MOST_OFFSET_S = 4e9
"""As far as the clock of a computer that begins in 1970 can be off."""

DataArgument = Annotated[Path, "Folder of scans, recording, or KITTI folder (with sequences/)."]
LogArgument = Annotated[Path, "Run folder, or its log.mcap, finished or not."]
DatasetOption = Annotated[
    str | None,
    typer.Option(
        autocompletion=completion.datasets, help="Kind of data: kitti, or a reader of kiss-icp; detected by default."
    ),
]
Numbering = Literal["raw", "learning", "learning-0"]
EncodingOption = Annotated[
    Numbering | None, "Numbering of the label files, if it cannot be detected: raw, learning (0-19), learning-0 (0-18)."
]
FoxgloveOption = Annotated[
    str | None,
    typer.Option(
        metavar="PORT",
        help="Serve the run live to Foxglove on this port of 127.0.0.1; ADDRESS:PORT for another address.",
    ),
]
LabelsOption = Annotated[
    str,
    typer.Option(
        autocompletion=completion.labels_or_files,
        help="Labels: auto (labels/ if present, else geometric), none, geometric, network:MODEL.onnx, or a folder (a "
        "relative one starts beside the scans).",
    ),
]
OverwriteOption = Annotated[bool, "Replace the run or the files that exist under this name."]
PresetOption = Annotated[
    str,
    typer.Option(
        autocompletion=completion.presets,
        help="Settings for an environment: driving, campus or indoor; auto: by the scans.",
    ),
]
SequenceOption = Annotated[str, "Sequence of the data set."]
ViewOption = Annotated[bool, "Show the run in the Rerun viewer while it is mapped."]
WithMapOption = Annotated[
    bool, typer.Option("--map", help="Also write the map: map.ply (cloud) and map.png (top view).")
]


def set_option(
    text: str, *, values: str = "VALUE", completed: Callable[[str], list[str]] = completion.settings
) -> OptionInfo:
    """An option `--set` with its help; `values`: what it shows behind the equals sign."""
    return typer.Option("--set", metavar=f"SECTION.KEY={values}", autocompletion=completed, help=text)


@dataclass(frozen=True)
class Settings:
    """The settings of a command."""

    config: Annotated[Path | None, "YAML file with the settings that differ from the defaults."] = None
    settings: Annotated[list[str] | None, set_option("Change one setting: section.key=value; may be repeated.")] = None

    def overrides(self) -> list[str]:
        """Changes of single settings, as for `load_config`."""
        return self.settings or []

    def load(self, *, base: "Config | None" = None) -> "Config":
        """The settings. Raises SegslamError as `load_config`; called early, it reports a wrong setting at once."""
        from segslam.core.config import load_config

        return load_config(self.config, self.overrides(), base=base)


@dataclass(frozen=True)
class RunSettings(Settings):
    """The settings of a command that makes a run."""

    refine_minutes: Annotated[
        float | None,
        typer.Option(
            min=0,
            metavar="MINUTES",
            help="Time limit of the adjustment of the whole map after the loops; 60 by default, 0: no adjustment.",
        ),
    ] = None

    overwrite: OverwriteOption = False

    def overrides(self) -> list[str]:
        """Those of `--set`, followed by that of `--refine-minutes`."""
        minutes = [] if self.refine_minutes is None else [f"adjustment.max_minutes={self.refine_minutes}"]
        return [*super().overrides(), *minutes]


@dataclass(frozen=True)
class RunOutput(RunSettings):
    """Settings, and what a run writes and shows beside its results: of `map`, `localise` and `live`."""

    with_map: WithMapOption = False
    map_file: Annotated[
        list[Path] | None,
        "Also write the map to this file in the run folder: .ply .pcd .las .laz .png .yaml; may be repeated.",
    ] = None
    view: ViewOption = False
    foxglove: FoxgloveOption = None

    def maps(self, folder: Path) -> tuple[list[Path], list[Path]]:
        """Map files as given, and as paths in the run folder. Raises SegslamError for an unknown kind of map."""
        names = [*map(Path, WITH_MAP if self.with_map else ()), *(self.map_file or ())]
        if not names:
            return [], []
        from segslam.output.map.write import check_names

        files = [folder / name for name in names]
        check_names(files)
        return names, files


@dataclass(frozen=True)
class ScanOptions:
    """Which scans of the data are used."""

    dataset: DatasetOption = None
    sequence: SequenceOption = "00"
    frames: Annotated[
        str | None, typer.Option(metavar="A:B[:STEP]", help="Use scans A to B by number, B excluded; every STEP-th.")
    ] = None
    topic: Annotated[str, "Point cloud topic, if the recording (rosbag, mcap) has more than one."] = ""

    def source(self, data: Path, labels: str = "none", encoding: Any = None) -> "DataSource":
        """What opens the scans."""
        from segslam.scans import DataSource

        return DataSource(data, self.sequence, self.dataset, labels, encoding, self.frames, self.topic)


@dataclass(frozen=True)
class RunOptions(ScanOptions):
    """What is mapped, and how: of `map` and `localise`."""

    labels: LabelsOption = "auto"
    encoding: EncodingOption = None
    odometry: Annotated[Path | None, "Trajectory to use instead of KISS-ICP (KITTI or TUM format, LiDAR frame)."] = None
    preset: PresetOption = "auto"
    resume: Annotated[bool, "Continue the interrupted run in --out."] = False


@dataclass(frozen=True)
class GnssOptions:
    """Position fixes and their use. Raises SegslamError for a wrong one."""

    gnss: Annotated[
        str | None,
        typer.Option(
            help="Position fixes: CSV, NMEA, RTKLIB .pos, a KITTI oxts folder, or a topic of the recording, as /fix; "
            "with `live`, a topic of ROS 2.",
            metavar="FIXES",
        ),
    ] = None
    gnss_use: Annotated[str, "fuse: also bend the map where held-out fixes confirm it; align: only place it."] = "fuse"
    gnss_offset: Annotated[float, "Seconds to add to the times of the fixes."] = 0.0

    def __post_init__(self) -> None:
        if self.gnss is None and (self.gnss_use, self.gnss_offset) != ("fuse", 0.0):
            raise SegslamError("--gnss-use, --gnss-offset: only for position fixes; give them with --gnss")
        if self.gnss is not None and not abs(self.gnss_offset) < MOST_OFFSET_S:
            raise SegslamError(f"--gnss-offset {self.gnss_offset}: not a difference of clocks in seconds")
        if self.gnss is not None and self.gnss_use not in GNSS_USES:
            raise SegslamError(f"--gnss-use {self.gnss_use}: unknown; known: {', '.join(GNSS_USES)}")

    def placing(self, recording: Path | None = None) -> Callable[[Path], str] | None:
        """Reads the fixes; returns what georeferences a run folder with them and tells the result. None without fixes.

        `recording`: where a topic is read. Raises SegslamError for fixes that cannot be read.
        """
        if self.gnss is None:
            return None
        from segslam.gnss.reading import read_fixes
        from segslam.output.georeferenced import georeference, summary

        fixes = read_fixes(self.gnss, recording=recording)
        return lambda folder: summary(georeference(folder, fixes, use=self.gnss_use, offset_s=self.gnss_offset))

    def placing_live(self, stack: ExitStack) -> Callable[[Path], str] | None:
        """Listens to a ROS 2 topic until `stack` ends; returns what georeferences a run with the fixes that arrived.

        None without a topic.
        """
        if self.gnss is None:
            return None
        from segslam.gnss.fixes import make_fixes
        from segslam.output.georeferenced import georeference_if_possible
        from segslam.run.live.ros import FixTopic

        name, topic = self.gnss, stack.enter_context(FixTopic(self.gnss))
        options: Any = {"use": self.gnss_use, "offset_s": self.gnss_offset}
        return lambda folder: georeference_if_possible(folder, lambda: make_fixes(name, topic.rows.copy()), **options)

    def recorded(self) -> dict[str, str]:
        """The options as the log of a run keeps them, for `resume`."""
        if self.gnss is None:
            return {}
        path = Path(self.gnss).expanduser()
        source = str(path.resolve()) if path.exists() else self.gnss
        return {"gnss": source, "gnss_use": self.gnss_use, "gnss_offset": repr(self.gnss_offset)}

    @classmethod
    def of(cls, recorded: Mapping[str, str]) -> "GnssOptions":
        """The options from the log of a run. Raises SegslamError if they are damaged."""
        try:
            offset_s = float(recorded.get("gnss_offset") or 0.0)
        except ValueError as error:
            raise SegslamError(f"gnss_offset {recorded['gnss_offset'][:40]}: damaged option in the log") from error
        return cls(recorded.get("gnss") or None, recorded.get("gnss_use") or "fuse", offset_s)


def with_options(command: Callable[..., None]) -> Callable[..., None]:
    """The command with the fields of each parameter that is annotated with a dataclass in place of that parameter.

    A text that annotates a parameter is its help: it makes an argument of a positional parameter, and an option of a
    keyword and of a field. An option without a name of its own is called like its parameter; a flag has no opposite
    `--no-...`. The help shows PATH, TEXT, N or NUMBER for a value, also for lists and optional values.
    """
    own = inspect.signature(command, eval_str=True)
    records: dict[str, type[Any]] = {
        name: one.annotation
        for name, one in own.parameters.items()
        if isinstance(one.annotation, type) and is_dataclass(one.annotation)
    }

    @wraps(command)
    def flat(**values: Any) -> None:
        for name, record in records.items():
            values[name] = record(**{field.name: values.pop(field.name) for field in fields(record)})
        command(**values)

    parameters = [
        _declared(each, is_argument=name not in records and one.kind is not one.KEYWORD_ONLY)
        for name, one in own.parameters.items()
        for each in (inspect.signature(records[name]).parameters.values() if name in records else [one])
    ]
    flat.__signature__ = own.replace(parameters=parameters)  # type: ignore[attr-defined]
    flat.__annotations__ = {one.name: one.annotation for one in parameters}
    return flat


def _declared(parameter: inspect.Parameter, *, is_argument: bool) -> inspect.Parameter:
    """The parameter as typer takes it."""
    hint, about = parameter.annotation.__origin__, parameter.annotation.__metadata__[0]
    if isinstance(about, str):
        about = typer.Argument(help=about) if is_argument else typer.Option(help=about)
    if isinstance(about, OptionInfo):
        about.metavar = about.metavar or _value_name(hint)
        if about.default is ...:  # where typer has the first name
            about.param_decls = (f"--{parameter.name.replace('_', '-')}",)
    return parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY, annotation=Annotated[hint, about])


def _value_name(hint: Any) -> str | None:
    """None for flags and choices."""
    return VALUE_NAMES.get(hint) or next(filter(None, map(_value_name, get_args(hint))), None)
