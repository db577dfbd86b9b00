"""Access by number to messages that can only be read one after the other."""

from collections.abc import Callable, Iterator
from typing import Generic, TypeVar

Message = TypeVar("Message")
MIN_BYTES = 32
"""Fewest bytes of a message with a cloud, compressed or not: its record header and stamp."""


class InOrder(Generic[Message]):
    """The messages of an iterator, which is started again to go back.

    Raises ValueError for a number of messages that a file of `num_bytes` cannot have.
    """

    def __init__(self, start: Callable[[], Iterator[Message]], num_messages: int, *, num_bytes: int) -> None:
        if num_messages > num_bytes // MIN_BYTES:
            raise ValueError(f"its index is damaged: it claims {num_messages} messages in {num_bytes} bytes")
        self._start = start
        self._num_messages = num_messages
        self._messages = start()
        self._next = 0
        self._damage = ""

    def __len__(self) -> int:
        return self._num_messages

    def __getitem__(self, index: int) -> Message:
        """Raises the exception of the iterator, and then ValueError for all messages after it."""
        if index < self._next:
            self._messages, self._next, self._damage = self._start(), 0, ""
        if self._damage:
            raise ValueError(self._damage)
        try:
            while True:
                message = next(self._messages)
                self._next += 1
                if self._next > index:
                    return message
        except StopIteration:
            self._damage = f"the recording ends after {self._next} of {self._num_messages} messages"
            raise ValueError(self._damage) from None
        except Exception as error:  # of a foreign reader, whose iterator has ended with it
            self._damage = f"the recording is damaged after {self._next} messages: {type(error).__name__}"
            raise
