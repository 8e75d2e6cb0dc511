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

# Formats of other programs: poses may be placed, and frames have their images.
PLACED: tuple[Format, ...] = ("mcap", "rrd")


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
    if format in PLACED:
        if region:
            raise UsageError(f"region: expected the format jsonl, found {format}")
        check_output(path, force=existing == "force")
        placement = placement or Placement.of(header)
        # Imported here because their libraries are extras.
        if format == "mcap":
            from cvo_edge.output.mcap import McapSink

            return McapSink(path, header, placement, told)
        from cvo_edge.output.rerun import RerunSink

        return RerunSink(path, header, placement)
    if placement is not None:
        raise UsageError(
            f"frames: expected {', '.join(PLACED)}, --mavlink or --view with --base, --map, frame "
            f"names or --unknown-variance, found {format} alone"
        )
    return Sink(path, format, header, region=region, existing=existing, told=told)
