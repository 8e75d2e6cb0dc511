"""Hands the newest message from a callback to a thread."""

from __future__ import annotations

from collections.abc import Iterator
from threading import Condition
from typing import Any


class Newest:
    """A place for one message: a newer one replaces it, and is counted as dropped.

    Iterating waits for messages until ``close``, and yields each with the number of those that were
    replaced before it.
    """

    def __init__(self) -> None:
        self._changed = Condition()
        self._message: Any = None
        self._dropped = 0
        self._closed = False

    def put(self, message: Any) -> None:
        """Leave a message; returns at once."""
        with self._changed:
            self._dropped += self._message is not None
            self._message = message
            self._changed.notify()

    def close(self) -> None:
        """End the iteration after the message that waits."""
        with self._changed:
            self._closed = True
            self._changed.notify()

    def __iter__(self) -> Iterator[tuple[Any, int]]:
        """Yield messages and how many were dropped."""
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._message is not None or self._closed)
                if self._message is None:
                    return
                message, dropped = self._message, self._dropped
                self._message, self._dropped = None, 0
            yield message, dropped
