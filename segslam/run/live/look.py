"""A look at the surroundings before a live run starts, to choose its settings."""

from contextlib import suppress
from pathlib import Path
from threading import Event, Thread

from segslam.core.types import BadScan, SegslamError
from segslam.run.live.source import Source
from segslam.run.live.waiting import Waiting
from segslam.scans import open_dataset
from segslam.scans.presets import extent_m, extent_of

PATIENCE_S = 2.0
"""Chosen: time to wait for the first cloud of a topic; a sensor that runs sends ten a second."""


def extent_in_folder(folder: Path) -> float | None:
    """The extent (m), as `segslam.presets.extent_m`, of the scans already in a folder; None if there are none."""
    with suppress(SegslamError):
        return extent_m(open_dataset(folder, labels="none"))
    return None


def extent_of_topic(topic: str) -> float | None:
    """The extent (m) of the first cloud of a ROS 2 topic; None if none arrives within two seconds.

    Raises SegslamError if the topic cannot be opened.
    """
    from segslam.run.live.ros import TopicSource

    return extent_of_first(TopicSource(topic))


def extent_of_first(source: Source) -> float | None:
    """The extent (m) of the first readable scan of a source, which is closed; None if none arrives in time."""
    waiting, stopped = Waiting(), Event()
    source.open(lambda text: None)
    feeder = Thread(target=source.feed, args=(waiting, stopped), daemon=True)
    feeder.start()
    try:
        while (arrival := waiting.take(PATIENCE_S)) is not None:
            with suppress(BadScan):
                return extent_of(arrival.read(arrival.index, arrival.stamp_ns).points)
    finally:
        stopped.set()
        feeder.join(timeout=PATIENCE_S)
        source.close()
    return None
