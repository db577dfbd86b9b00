"""A log of our own, everything that is read from it, and logs with odd content and correct checksums."""

import io
import logging
import random
import re
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from logging.handlers import BufferingHandler
from pathlib import Path
from typing import Any

from helpers.made_logs import CONFIG, assert_same, made_result, made_steps
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from fuzz.mutation import mutate, replaced
from segslam.core.types import LoopAttempt, Step, Trajectory
from segslam.output.log import LogWriter, RunLog

VALUE = re.compile(rb'"[^"]*"|[^\s,:\[\]{}"]+')
"""A name or a value of JSON."""


def write_whole(path: Path) -> Path:
    """A whole log with loops, keyframes, an estimate and a result."""
    steps = list(made_steps(26))
    estimate, trajectory = made_result(steps)
    attempts = tuple(attempt for step in steps for attempt in step.attempts)
    with LogWriter(path, config=CONFIG, dataset="made", reference=trajectory, options={"frames": "0:26"}) as writer:
        for step in steps:
            writer.write(step)
        writer.write_result(estimate, trajectory, attempts)
    return path


class Read:
    """Everything that a log gives."""

    def __init__(self, log: RunLog) -> None:
        self.head = log.config, dict(log.run), dict(log.packages), dict(log.options), log.T_camera_lidar
        with _warnings() as warnings:
            self.steps: list[Step] = list(log.steps())
        self.is_warned = bool(warnings.buffer)
        self.num_steps = log.num_steps()
        self.reference: Trajectory | None = log.reference()
        self.result = log.result()
        self.late: tuple[LoopAttempt, ...] = log.late_loops()
        self.keyframes, cloud = log.keyframes()
        self.clouds = [cloud(number) for number in range(len(self.keyframes))]

    def check_part_of(self, whole: "Read") -> None:
        """Raises AssertionError unless each part is that of the whole log, or missing."""
        assert self.head == whole.head
        assert self.is_warned or len(self.steps) == len(whole.steps)
        for mine, theirs in (
            (self.steps, whole.steps),
            (self.keyframes, whole.keyframes),
            (self.clouds, whole.clouds),
            (self.late, whole.late),
        ):
            assert_same(tuple(mine), tuple(theirs[: len(mine)]))
        for mine, theirs in ((self.reference, whole.reference), (self.result, whole.result)):
            assert mine is None or assert_same(mine, theirs) is None


@contextmanager
def _warnings() -> Iterator[BufferingHandler]:
    """The warnings of the reader, though the long run disables all."""
    handler, logger = BufferingHandler(capacity=1000), logging.getLogger("segslam.output.log.reader")
    disabled = logging.root.manager.disable
    logging.disable(logging.NOTSET)
    logger.addHandler(handler)
    try:
        yield handler
    finally:
        logger.removeHandler(handler)
        logging.disable(disabled)


def odd(rng: random.Random, whole: Path) -> bytes:
    """The same log, its checksums correct, with one message, schema or record of metadata changed."""
    metadata, messages = _content(whole)
    chosen = rng.random()
    output = io.BytesIO()
    writer = Writer(output, chunk_size=2**14, compression=CompressionType.ZSTD)
    writer.start()
    victim = rng.randrange(len(metadata)) if chosen < 0.2 else -1
    for number, record in enumerate(metadata):
        values = dict(record.metadata)
        if number == victim and values:
            key = rng.choice(sorted(values))
            values[key] = _odd_text(rng, values[key])
        writer.add_metadata(record.name, values)
    victim = rng.randrange(len(messages)) if chosen >= 0.3 else -1
    channels: dict[int, int] = {}
    for number, (schema, channel, message) in enumerate(messages):
        if channel.id not in channels:
            described = schema.data
            if 0.2 <= chosen < 0.3 and rng.random() < 0.1:
                described = _odd_text(rng, described.decode(errors="replace")).encode(errors="replace")
            schema_id = writer.register_schema(schema.name, schema.encoding, described)
            channels[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, schema_id)
        content = message.data
        if number == victim:
            is_json = channel.message_encoding == "json" and rng.random() < 0.7
            content = replaced(rng, content, VALUE) if is_json else mutate(rng, content, is_text=False)
        writer.add_message(channels[channel.id], message.log_time, content, message.publish_time)
    writer.finish()
    return output.getvalue()


@cache
def _content(whole: Path) -> tuple[list[Any], list[Any]]:
    """The records of metadata, without the checksum, which would refuse each change, and the messages."""
    with whole.open("rb") as stream:
        reader = make_reader(stream)
        metadata = [record for record in reader.iter_metadata() if record.name != "segslam.check"]
        return metadata, list(reader.iter_messages(log_time_order=False))


def _odd_text(rng: random.Random, text: str) -> str:
    return mutate(rng, text.encode(), is_text=True).decode(errors="replace")
