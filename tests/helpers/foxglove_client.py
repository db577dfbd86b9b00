"""A viewer like Foxglove: subscribes to all channels of a server and stores the messages."""

import json
import struct
from collections import defaultdict
from threading import Thread
from typing import Any

from websockets.sync.client import ClientConnection, connect
from websockets.typing import Subprotocol

PROTOCOL = "foxglove.sdk.v1"
MESSAGE = struct.Struct("<BIQ")
"""Operation, subscription and time (ns), before the data of a message."""


class Viewer(Thread):
    """Receives until the server closes."""

    def __init__(self, url: str) -> None:
        super().__init__(daemon=True)
        self._url = url
        self.channels: dict[str, dict[str, Any]] = {}
        self.messages: dict[str, list[tuple[int, bytes]]] = defaultdict(list)
        self._topic_of: dict[int, str] = {}
        self.start()

    def run(self) -> None:
        with connect(self._url, subprotocols=[Subprotocol(PROTOCOL)], max_size=None) as socket:
            for message in socket:
                if isinstance(message, str):
                    self._hear(json.loads(message), socket)
                else:
                    operation, subscription, stamp_ns = MESSAGE.unpack_from(message)
                    if operation == 1:
                        self.messages[self._topic_of[subscription]].append((stamp_ns, message[MESSAGE.size :]))

    def _hear(self, output: dict[str, Any], socket: ClientConnection) -> None:
        if output["op"] != "advertise":
            return
        for channel in output["channels"]:
            self.channels[channel["topic"]] = channel
            self._topic_of[channel["id"]] = channel["topic"]
        wanted = [{"id": channel["id"], "channelId": channel["id"]} for channel in output["channels"]]
        socket.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))
