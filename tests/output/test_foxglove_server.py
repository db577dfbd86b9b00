"""The channels of the log, as a viewer receives them over a WebSocket."""

import json
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from threading import Thread
from time import monotonic, sleep
from typing import Any

import numpy as np
import pytest

pytest.importorskip("foxglove", reason="foxglove-sdk is not installed")
pytest.importorskip("websockets", reason="websockets is not installed")

import foxglove
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from helpers.commands import run
from helpers.finished_run import make_run
from helpers.foxglove_client import PROTOCOL, Viewer
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Origin, Subprotocol

from segslam.cli.console import Terminal
from segslam.cli.viewers import serve_foxglove
from segslam.core.types import SegslamError
from segslam.output.foxglove_server import MOST_MESSAGES, FoxgloveServer, is_allowed, parse_address
from segslam.output.log import read_log, schema
from segslam.output.log.schema import channels


def _wait(condition: Callable[[], object], seconds: float = 20.0) -> None:
    end = monotonic() + seconds
    while not condition():
        assert monotonic() < end, "waited in vain"
        sleep(0.02)


def test_a_viewer_is_offered_every_channel_of_a_log_and_gets_what_is_sent() -> None:
    with FoxgloveServer("0") as server:
        assert server.url.startswith("ws://127.0.0.1:")
        viewer = Viewer(server.url)
        _wait(lambda: len(viewer.channels) == len(channels()))
        for channel in channels():
            offered = viewer.channels[channel.topic]
            assert (offered["encoding"], offered["schemaName"]) == (channel.encoding, channel.schema_name)

        def send() -> bool:
            server.send(schema.MEMORY, b'{"rss_mb": 1}', 7)
            return bool(viewer.messages[schema.MEMORY])

        _wait(send)  # again and again: the subscription takes its time
        assert viewer.messages[schema.MEMORY][0] == (7, b'{"rss_mb": 1}')


@pytest.mark.parametrize(
    ("origin", "allowed"),
    [
        ("https://app.foxglove.dev", True),
        ("https://foxglove.dev", True),
        ("http://localhost:8080", True),
        ("http://[::1]:8080", True),
        ("file://", True),
        ("http://evil.example", False),
        ("https://evilfoxglove.dev", False),
        ("http://app.foxglove.dev", False),
        ("https://foxglove.dev.evil.example", False),
        ("http://127.0.0.1.evil.example:8765", False),
        ("null", False),
        ("", False),
        ("http://[", False),
    ],
)
def test_a_web_page_reads_a_run_only_if_its_site_is_a_viewer(origin: str, allowed: bool) -> None:
    assert is_allowed(origin) == allowed


def test_a_page_of_another_site_is_refused_and_others_are_served() -> None:
    with FoxgloveServer("0") as server:
        for origin in (Origin("http://evil.example"), Origin("null")):
            with pytest.raises(InvalidStatus, match="403"):
                connect(server.url, subprotocols=[Subprotocol(PROTOCOL)], origin=origin)
        with connect(
            server.url, subprotocols=[Subprotocol(PROTOCOL)], origin=Origin("https://app.foxglove.dev")
        ) as one:
            assert json.loads(one.recv())["op"] == "serverInfo"


def test_an_address_that_others_reach_is_announced(capsys: pytest.CaptureFixture[str]) -> None:
    for address, shown in (("0.0.0.0:0", True), ("127.0.0.1:0", False)):
        with ExitStack() as stack:
            serve_foxglove(address, stack, Terminal())
        assert ("there is no password" in capsys.readouterr().err) == shown


def test_late_subscribers_receive_the_last_map() -> None:
    with FoxgloveServer("0") as server:
        for stamp_ns in (1, 2):
            server.send_map(np.full((3, 3), stamp_ns, float), np.zeros(3, np.uint8), stamp_ns)
        viewer = Viewer(server.url)
        _wait(lambda: viewer.messages[schema.MAP])
        stamp_ns, data = viewer.messages[schema.MAP][0]
    cloud = PointCloud.FromString(data)
    assert (stamp_ns, cloud.frame_id, len(cloud.data) // cloud.point_stride) == (2, "world", 3)


@pytest.mark.slow
def test_a_replay_is_served_while_it_runs(tmp_path: Path) -> None:
    """The port is known only to the server: whoever opens one is followed."""
    folder = make_run(tmp_path / "run").folder
    viewers: list[Viewer] = []
    opened = FoxgloveServer.__init__

    def open_and_watch(self: FoxgloveServer, address: str) -> None:
        opened(self, address)
        viewers.append(Viewer(self.url))
        _wait(lambda: len(viewers[0].channels) == len(channels()))
        sleep(0.5)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(FoxgloveServer, "__init__", open_and_watch)
        assert run("replay", folder, "--out", tmp_path / "again", "--foxglove", "0", "--quiet") == 0
    viewers[0].join(timeout=10)
    messages = viewers[0].messages
    served = [json.loads(data)["scan_index"] for _, data in messages[schema.STEP]]
    assert served == [step.scan_index for step in read_log(tmp_path / "again" / "log.mcap").steps()]
    assert {FrameTransform.FromString(data).child_frame_id for _, data in messages[schema.TRANSFORMS]} == {
        "odom",
        "lidar",
    }
    assert messages[schema.RESULT]


@pytest.mark.slow
def test_a_viewer_that_reads_nothing_delays_nothing() -> None:
    """64 MB, more than the system keeps for a connection; without end it would wait for the viewer."""
    with (
        FoxgloveServer("0") as server,
        connect(server.url, subprotocols=[Subprotocol(PROTOCOL)], max_size=None, max_queue=1) as viewer,
    ):
        offered: list[dict[str, Any]] = []
        while len(offered) < len(channels()):
            offered += json.loads(viewer.recv()).get("channels", [])
        wanted = [{"id": channel["id"], "channelId": channel["id"]} for channel in offered]
        viewer.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))
        sleep(0.5)
        sender = Thread(
            target=lambda: [server.send(schema.POINTS, bytes(10**5), n) for n in range(5 * MOST_MESSAGES)], daemon=True
        )
        sender.start()
        sender.join(timeout=60)
        assert not sender.is_alive()


@pytest.mark.parametrize(
    ("address", "expected"),
    [("8765", ("127.0.0.1", 8765)), ("0.0.0.0:1", ("0.0.0.0", 1)), ("[::1]:8765", ("::1", 8765))],
)
def test_a_port_alone_is_on_loopback(address: str, expected: tuple[str, int]) -> None:
    assert parse_address(address) == expected


@pytest.mark.parametrize("address", ["", "here", "8765:", "70000", "-1"])
def test_an_invalid_port_is_rejected(address: str) -> None:
    with pytest.raises(SegslamError, match="give a port"):
        parse_address(address)


def test_a_port_in_use_is_reported() -> None:
    with FoxgloveServer("0") as server, pytest.raises(SegslamError, match="cannot listen there"):
        FoxgloveServer(server.url.rpartition("/")[2])


def test_a_port_in_use_leaves_no_server_behind(monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[Any] = []
    start = foxglove.start_server
    monkeypatch.setattr(foxglove, "start_server", lambda **options: started.append(start(**options)) or started[-1])
    with FoxgloveServer("0") as server, pytest.raises(SegslamError, match="cannot listen there"):
        FoxgloveServer(server.url.rpartition("/")[2])
    assert len(started) == 1


def test_without_the_package_one_line_has_the_install_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = make_run(tmp_path / "run").folder
    monkeypatch.setitem(__import__("sys").modules, "segslam.output.foxglove_server", None)
    assert run("replay", folder, "--out", tmp_path / "again", "--foxglove", "8765", "--quiet") == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "--foxglove needs a package: pip install" in line
    assert not (tmp_path / "again").exists()
