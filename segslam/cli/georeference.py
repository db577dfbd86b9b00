"""`segslam georeference`, and the options of commands that place a run on the globe."""

from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from segslam.cli.checks import check_exists
from segslam.cli.console import Terminal, print_out
from segslam.core.errors import SegslamError

USES = ("fuse", "align")


@dataclass(frozen=True)
class GnssOptions:
    """Position fixes and their use."""

    gnss: Annotated[
        str | None,
        typer.Option(
            help="Position fixes: CSV, NMEA, RTKLIB .pos, a KITTI oxts folder, or a topic of the recording, as /fix.",
            metavar="FIXES",
        ),
    ] = None
    gnss_use: Annotated[
        str, typer.Option(help="fuse: also bend the map where held-out fixes confirm it; align: only place it.")
    ] = "fuse"
    gnss_offset: Annotated[float, typer.Option(help="Seconds to add to the times of the fixes.")] = 0.0

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


def georeference(
    run: Annotated[Path, typer.Argument(help="Folder of a finished run.")], *, gnss: GnssOptions, terminal: Terminal
) -> None:
    """Place a finished run on the globe by its position fixes, right also where the receiver is wrong.

    Writes georeference.json, gnss.csv (each fix: kept, or why not), poses_geodetic.csv and poses_enu_tum.txt into its
    folder. `segslam export` then writes maps with a coordinate system.

    Example: segslam georeference runs/00 --gnss fixes.csv
    """
    check_exists(run, "give the folder of a finished run")
    terminal.announce(f"georeference: reading {gnss.gnss}")
    from segslam.output.folder import folder_of
    from segslam.output.georeferenced import FILE
    from segslam.output.log import read_log
    from segslam.output.report import write_report

    folder = folder_of(run)
    data = read_log(folder).options.get("data")  # may have a topic with fixes
    place = gnss.placing(Path(data) if data else None)
    if place is None:
        raise SegslamError("--gnss: give the position fixes, as in --gnss fixes.csv")
    placed = place(folder)
    write_report(folder)
    if terminal.json:
        print_out((folder / FILE).read_text(encoding="utf-8").rstrip())
    else:
        terminal.say(f"{placed}\nresults in {folder}: georeference.json, gnss.csv, poses_geodetic.csv")
