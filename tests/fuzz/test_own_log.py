"""Our own log, damaged in every way: its steps before the damage, or one error that names the file.

SEGSLAM_FUZZ_LOG=N reads N mutants of each kind and N cuts (41,000 are every cut), instead of a sample.
"""

import json
import logging
import os
import random
import re
import resource
import signal
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import cache
from logging.handlers import BufferingHandler
from pathlib import Path
from typing import Any

import pytest
from helpers.made_logs import CONFIG, assert_same, made_result, made_steps, write_log
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from segslam.log import LogWriter, RunLog, read_log
from segslam.types import LoopAttempt, SegslamError, Step, Trajectory

NUM = int(os.environ.get("SEGSLAM_FUZZ_LOG", "0"))
SECONDS, MEMORY_BYTES = 5, 2**30
"""Limits of one input; a chunk may have some megabytes."""
ODD = (b"", b"0", b"-1", b"NaN", b"1e999", b"null", b"[]", b"{}", b"\xff", b'"', b"9" * 30, b"true", b"[" * 3000)
NUMBERS = (0, 1, 2**31 - 1, 2**32 - 1, 2**63 - 1, 2**63, 2**64 - 1, 10**12)

WARNINGS = BufferingHandler(capacity=1000)
"""The warnings of the reader."""
logging.getLogger("segslam.log.reader").addHandler(WARNINGS)


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A whole log with loops, keyframes, an estimate and a result."""
    path, steps = tmp_path_factory.mktemp("log") / "log.mcap", list(made_steps(26))
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
        WARNINGS.buffer.clear()
        self.head = log.config, dict(log.run), dict(log.packages), dict(log.options), log.T_camera_lidar
        self.steps: list[Step] = list(log.steps())
        self.is_warned = bool(WARNINGS.buffer)
        self.num_steps = log.num_steps()
        self.reference: Trajectory | None = log.reference()
        self.result = log.result()
        self.late: tuple[LoopAttempt, ...] = log.late_loops()
        recorded = log.keyframes()
        self.keyframes = [recorded[number] for number in range(len(recorded))]
        self.clouds = [recorded.cloud(number) for number in range(len(recorded))]

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


def mutated(rng: random.Random, data: bytes) -> bytes:
    """A copy with one to three changes: bits, bytes, numbers, blocks that are lost, doubled or moved, and a cut."""
    made = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 3))):
        start = rng.randrange(len(made)) if made else 0
        end = min(len(made), start + rng.choice((1, 2, 4, 8, 64, 1024)))
        match rng.randrange(7):
            case 0 if made:
                made[start] ^= 1 << rng.randrange(8)
            case 1:
                made[start:end] = rng.randbytes(end - start)
            case 2:
                del made[start:end]
            case 3:
                del made[start:]
            case 4:
                made[start:start] = made[start:end]
            case 5:
                made[start : start + 8] = rng.choice(NUMBERS).to_bytes(8, "little")
            case _:
                other = rng.randrange(len(made) + 1)
                made[start:end] = made[other : other + end - start]
    return bytes(made)


def mutated_content(rng: random.Random, whole: Path, made: Path) -> bytes:
    """The same log, its checksums correct, with one message, schema or record of metadata changed."""
    metadata, messages = _content(whole)
    chosen = rng.random()
    with made.open("wb") as output:
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
                is_text = channel.message_encoding == "json" and rng.random() < 0.7
                content = _odd_json(rng, content) if is_text else mutated(rng, content)
            writer.add_message(channels[channel.id], message.log_time, content, message.publish_time)
        writer.finish()
    return made.read_bytes()


@cache
def _content(whole: Path) -> tuple[list[Any], list[Any]]:
    """The records of metadata, without the checksum, which would refuse each change, and the messages."""
    with whole.open("rb") as stream:
        reader = make_reader(stream)
        metadata = [record for record in reader.iter_metadata() if record.name != "segslam.check"]
        return metadata, list(reader.iter_messages(log_time_order=False))


def _odd_text(rng: random.Random, text: str) -> str:
    return mutated(rng, text.encode() or b"0").decode(errors="replace")


def _odd_json(rng: random.Random, content: bytes) -> bytes:
    """A JSON message with one value or name replaced."""
    places = [found.span() for found in re.finditer(rb'"[^"]*"|[^\s,:\[\]{}"]+', content)]
    start, end = rng.choice(places)
    return content[:start] + rng.choice(ODD) + content[end:]


def _in_child(work: Callable[[], str]) -> str:
    """The outcome of some work in a forked process with limits, or what ended it."""
    reading, writing = os.pipe()
    pid = os.fork()
    if pid == 0:
        with suppress(BaseException):
            used = 4096 * int(Path("/proc/self/statm").read_text().split()[0])
            resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY_BYTES, used + MEMORY_BYTES))
            os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
            os.write(writing, work().encode()[-60_000:])
        os._exit(0)
    os.close(writing)
    with os.fdopen(reading, "rb") as pipe:
        outcome = pipe.read().decode()
    status = os.waitpid(pid, 0)[1]
    return f"{outcome}\nDEFECT signal {os.WTERMSIG(status)}" if os.WIFSIGNALED(status) else outcome


def _outcome(path: Path, whole: Read | None) -> str:
    """`part`, `refused`, or the defect."""

    def too_long(*_: object) -> None:
        raise TimeoutError

    signal.signal(signal.SIGALRM, too_long)
    signal.setitimer(signal.ITIMER_REAL, SECONDS)
    try:
        read = Read(read_log(path))
        if whole is not None:
            read.check_part_of(whole)
    except SegslamError as error:
        return "refused" if str(path) in str(error) else f"DEFECT without the file: {error}"
    except BaseException as error:
        frame = traceback.extract_tb(error.__traceback__)[-1]
        return f"DEFECT {type(error).__name__} {Path(frame.filename).name}:{frame.lineno} {str(error)[:80]}".replace(
            "\n", " "
        )
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
    return "part"


def _check_all(tmp_path: Path, inputs: Iterator[bytes], whole: Read | None) -> None:
    """All inputs are read in one child; fails with the number and an example of each defect."""
    path = tmp_path / "log.mcap"

    def work() -> str:
        outcomes: dict[str, Any] = Counter()
        for number, data in enumerate(inputs):
            path.write_bytes(data)
            outcome = _outcome(path, whole)
            if outcome.startswith("DEFECT") and outcome not in outcomes:
                (tmp_path / f"defect{number}.mcap").write_bytes(data)
            outcomes[outcome] += 1
        return json.dumps(outcomes)

    found = _in_child(work)
    assert "DEFECT" not in found, found.replace("DEFECT", "\nDEFECT")
    outcomes = json.loads(found)
    print(outcomes)
    assert sum(outcomes.values()) > 0


def test_a_cut_anywhere_gives_the_steps_before_it(tmp_path: Path) -> None:
    short = write_log(tmp_path / "short.mcap", list(made_steps(6)))
    data = short.read_bytes()
    sizes = random.Random(0).sample(range(len(data)), min(NUM or 60, len(data)))
    _check_all(tmp_path, (data[:size] for size in sizes), Read(read_log(short)))


def test_damaged_bytes_give_the_steps_before_them(log: Path, tmp_path: Path) -> None:
    data, rng = log.read_bytes(), random.Random(1)
    _check_all(tmp_path, (mutated(rng, data) for _ in range(NUM or 100)), Read(read_log(log)))


def test_odd_content_with_correct_checksums_is_read_or_refused(log: Path, tmp_path: Path) -> None:
    rng = random.Random(2)
    made = tmp_path / "content.mcap"
    _check_all(tmp_path, (mutated_content(rng, log, made) for _ in range(NUM or 60)), None)


def test_an_index_with_the_correct_checksum_and_wrong_places_is_not_followed(log: Path, tmp_path: Path) -> None:
    """A damaged checksum of the settings refuses the log; a damaged index costs time only."""
    data = bytearray(log.read_bytes())
    data[-40] ^= 1
    path = tmp_path / "log.mcap"
    path.write_bytes(data)
    assert read_log(path).result() is not None
    setting = data.index(b"min_overlap")
    data[setting + 14] ^= 1
    path.write_bytes(data)
    with pytest.raises(SegslamError, match=r"log\.mcap: the settings at its start are damaged"):
        read_log(path)
