"""Open the sink that an output's name and format ask for."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Protocol

from cvo_edge.errors import UsageError
from cvo_edge.estimate import PoseInterval
from cvo_edge.files import check_output
from cvo_edge.output.messages import Placement
from cvo_edge.output.records import Header
from cvo_edge.output.sinks import Sink
from cvo_edge.vocabulary import Existing, Format


class Writing(Protocol):
    """What writes estimates."""

    def write(self, estimate: PoseInterval) -> None:
        """Write one estimate; raises SinkError."""


def open_sink(
    path: str,
    format: Format,
    header: Header,
    placement: Placement | None = None,
    *,
    region: bool = False,
    existing: Existing = "replace",
    told: Callable[[str], None] | None = None,
) -> AbstractContextManager[Writing]:
    """Return the sink for a format.

    ``placement`` is for formats of other programs; None: the frames of the header. ``existing`` and
    ``told`` are those of ``LineFile``; a file of messages is never appended to.

    Raises UsageError for a placement or a region that the format does not have, and SinkError.
    """
    if format == "mcap":
        # Imported here because its libraries are an extra.
        from cvo_edge.output.mcap import McapSink

        if region:
            raise UsageError("region: expected the format jsonl, found mcap")
        check_output(path, force=existing == "force")
        return McapSink(path, header, placement or Placement.of(header))
    if placement is not None:
        raise UsageError(
            f"frames: expected the format mcap with --base, --map, frame names or "
            f"--unknown-variance, found {format}"
        )
    return Sink(path, format, header, region=region, existing=existing, told=told)
