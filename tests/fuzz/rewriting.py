"""MCAP files with other contents of their messages, and right checksums."""

import io
from collections.abc import Callable

from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer


def rewritten(recording: bytes, change: Callable[[bytes], bytes]) -> bytes:
    """The recording with its second message changed."""
    out = io.BytesIO()
    writer = Writer(out, compression=CompressionType.NONE)
    writer.start("ros2", "test")
    schemas: dict[int, int] = {}
    channels: dict[int, int] = {}
    for number, (schema, channel, message) in enumerate(make_reader(io.BytesIO(recording)).iter_messages()):
        assert schema is not None
        if schema.id not in schemas:
            schemas[schema.id] = writer.register_schema(schema.name, schema.encoding, schema.data)
        if channel.id not in channels:
            channels[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, schemas[schema.id])
        data = change(message.data) if number == 2 else message.data
        writer.add_message(channels[channel.id], message.log_time, data, message.publish_time)
    writer.finish()
    return out.getvalue()
