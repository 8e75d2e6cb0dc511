"""Items that the same functions are applied to here or on a Ray cluster.

A calculation over many recordings is written once, as functions of one recording and the merging
of what they return. ``map`` leaves results where they are; ``collect`` brings them here, in the
order of the items. Whoever merges them sees the same values in the same order with both kinds.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Protocol, TypeVar

from cvo_edge.errors import CvoError

T = TypeVar("T")
U = TypeVar("U")

# Receives what is being done, and how many items of how many are done.
Watch = Callable[[str, int, int], None]

# Retries of a task after its process or machine has died.
_RETRIES = 3
# Tasks for each core: items differ in length, and a task costs a millisecond.
_TASKS_PER_CORE = 8
_MOST_PER_TASK = 16


class ClusterError(CvoError):
    """A cluster lost a task more often than it is retried, or has no room for what it gave."""


class Spread(Protocol[T]):
    """Items, wherever they are."""

    def __len__(self) -> int:
        """Return the number of items."""

    def map(self, function: Callable[..., U], *each: Sequence[object], what: str = "") -> Spread[U]:
        """Apply a function to each item, and to its entry of each further sequence.

        ``what`` is the name that this work has on a progress line; "": it is not shown.
        """

    def take(self, places: Sequence[int]) -> Spread[T]:
        """Return some of the items, in this order."""

    def collect(self) -> list[T]:
        """Return the items themselves; raises the error of the first item that failed."""


class Here(list[T]):
    """Items in this process; ``map`` raises the first error at once."""

    def __init__(self, items: Sequence[T], watch: Watch | None = None) -> None:
        super().__init__(items)
        self._watch = watch

    def map(self, function: Callable[..., U], *each: Sequence[object], what: str = "") -> Spread[U]:
        """Apply a function to each item."""
        found: list[U] = []
        for arguments in zip(self, *each, strict=True):
            found.append(function(*arguments))
            if what and self._watch:
                self._watch(what, len(found), len(self))
        return Here(found, self._watch)

    def take(self, places: Sequence[int]) -> Spread[T]:
        """Return some of the items."""
        return Here([self[place] for place in places], self._watch)

    def collect(self) -> list[T]:
        """Return the items."""
        return self


class OnRay:
    """Items in the object store of a cluster; ``map`` starts tasks and does not wait for them.

    All machines need the same packages. What a killed worker held is computed again.

    Parameters
    ----------
    ray
        The module, joined to a cluster.
    references
        Of one object each.
    what, watch
        Name of the work that gives the items, and who is told how far it is.
    """

    # ray has no types.
    def __init__(
        self,
        ray: Any,  # noqa: ANN401
        references: Sequence[Any],
        watch: Watch | None = None,
        what: str = "",
    ) -> None:
        self._ray, self._references, self._watch, self._what = ray, references, watch, what

    @classmethod
    def of(
        cls,
        ray: Any,  # noqa: ANN401
        items: Sequence[object],
        watch: Watch | None = None,
    ) -> OnRay:
        """Put items into the object store."""
        return cls(ray, [ray.put(item) for item in items], watch)

    def __len__(self) -> int:
        """Return the number of items."""
        return len(self._references)

    def map(self, function: Callable[..., object], *each: Sequence[object], what: str = "") -> Any:  # noqa: ANN401
        """Apply a function to each item, several in a task."""
        cores = max(1, int(self._ray.cluster_resources().get("CPU", 1)))
        size = min(_MOST_PER_TASK, -(-len(self) // (_TASKS_PER_CORE * cores)))
        remote = self._ray.remote(num_cpus=1, max_retries=_RETRIES)(_on_a_worker)
        shared = self._ray.put(function)
        found: list[Any] = []
        for first in range(0, len(self), size):
            some = slice(first, first + size)
            items = self._references[some]
            arguments = [list(sequence[some]) for sequence in each]
            returned = remote.options(num_returns=len(items)).remote(
                Path.cwd(), shared, arguments, *items
            )
            found += returned if len(items) > 1 else [returned]
        return OnRay(self._ray, found, self._watch, what)

    def take(self, places: Sequence[int]) -> OnRay:
        """Return some of the items."""
        some = [self._references[place] for place in places]
        return OnRay(self._ray, some, self._watch, self._what)

    def collect(self) -> list[Any]:
        """Wait for the items, and return them."""
        if self._what and self._watch:
            for count, reference in enumerate(self._references, start=1):
                self._ray.wait([reference])
                self._watch(self._what, count, len(self))
        try:
            # All together, ``get`` raises the error that came first in time.
            self._ray.wait(self._references, num_returns=len(self))
            return [self._ray.get(reference) for reference in self._references]
        except self._ray.exceptions.RayTaskError as error:
            if isinstance(error.cause, CvoError):
                raise error.cause from None
            raise
        except self._ray.exceptions.RayError as error:
            line = " ".join(str(error).split())[:200]
            raise ClusterError(f"expected what a task of the cluster gave, found: {line}") from None


def _on_a_worker(
    folder: Path, function: Callable[..., object], each: Sequence[Sequence[object]], *items: object
) -> object:
    # Relative paths are those of the process that started the tasks.
    with suppress(OSError):
        os.chdir(folder)
    found = [function(*arguments) for arguments in zip(items, *each, strict=True)]
    return found if len(found) > 1 else found[0]
