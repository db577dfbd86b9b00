"""Options of commands that place a run on the globe."""

from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from segslam.core.errors import SegslamError

USES = ("fuse", "align")
GnssOption = Annotated[
    str | None,
    typer.Option(
        help="Position fixes: CSV, NMEA, RTKLIB .pos, a KITTI oxts folder, or a topic of the recording, as /fix.",
        metavar="FIXES",
    ),
]
GnssUseOption = Annotated[
    str, typer.Option(help="fuse: also bend the map where held-out fixes confirm it; align: only place it.")
]
GnssOffsetOption = Annotated[float, typer.Option(help="Seconds to add to the times of the fixes.")]


@dataclass(frozen=True)
class GnssOptions:
    """Position fixes and their use."""

    gnss: GnssOption = None
    gnss_use: GnssUseOption = "fuse"
    gnss_offset: GnssOffsetOption = 0.0

    def placing(self, recording: Path | None = None) -> Callable[[Path], str] | None:
        """Reads the fixes; returns what georeferences a run folder with them and tells the result. None without fixes.

        `recording`: where a topic is read. Raises SegslamError for a wrong option, or fixes that cannot be read.
        """
        if self.gnss is None:
            return None
        self._check_use()
        from segslam.gnss.reading import read_fixes
        from segslam.output.georeferenced import georeference, summary

        fixes = read_fixes(self.gnss, recording=recording)
        return lambda folder: summary(georeference(folder, fixes, use=self.gnss_use, offset_s=self.gnss_offset))

    def placing_live(self, stack: ExitStack) -> Callable[[Path], str] | None:
        """Listens to a ROS 2 topic until `stack` ends; returns what georeferences a run with the fixes that arrived.

        None without a topic. Raises SegslamError for a wrong option.
        """
        if self.gnss is None:
            return None
        self._check_use()
        from segslam.output.georeferenced import georeference_if_possible
        from segslam.run.live.ros import FixTopic

        name, topic = self.gnss, stack.enter_context(FixTopic(self.gnss))
        return lambda folder: georeference_if_possible(
            folder, name, topic.rows.copy(), use=self.gnss_use, offset_s=self.gnss_offset
        )

    def _check_use(self) -> None:
        if self.gnss_use not in USES:
            raise SegslamError(f"--gnss-use {self.gnss_use}: unknown; known: {', '.join(USES)}")

    def recorded(self) -> dict[str, str]:
        """The options as the log of a run keeps them, for `resume`."""
        if self.gnss is None:
            return {}
        path = Path(self.gnss).expanduser()
        source = str(path.resolve()) if path.exists() else self.gnss
        return {"gnss": source, "gnss_use": self.gnss_use, "gnss_offset": repr(self.gnss_offset)}

    @classmethod
    def of(cls, recorded: Mapping[str, str]) -> "GnssOptions":
        """The options from the log of a run. Raises SegslamError for a damaged offset."""
        try:
            offset_s = float(recorded.get("gnss_offset") or 0.0)
        except ValueError as error:
            raise SegslamError(f"gnss_offset {recorded['gnss_offset'][:40]}: damaged option in the log") from error
        return cls(recorded.get("gnss") or None, recorded.get("gnss_use") or "fuse", offset_s)
