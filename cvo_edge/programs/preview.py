"""A panel on the terminal that shows a run as it goes, for a login by SSH."""

from __future__ import annotations

import sys
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING

from cvo_edge.errors import UsageError, printable
from cvo_edge.estimate import PoseInterval
from cvo_edge.overlay import TO_CM_OR_DEG, round_up
from cvo_edge.programs.progress import done_text
from cvo_edge.programs.run import RunSummary
from cvo_edge.record import Status

if TYPE_CHECKING:
    from rich.live import Live
    from rich.text import Text

_SECONDS_BETWEEN_UPDATES = 0.2
_WIDTH, _BAR = 80, 49
_TOLD = 3
_STYLES = {Status.OK: "green", Status.DEGRADED: "yellow", Status.INVALID: "red"}


class Preview:
    """Shows the last frame, the counts and the last doubts, at most five times a second.

    Parameters
    ----------
    live
        The part of the terminal that is redrawn.
    summary
        Counts of the run, updated by the caller.
    total
        Total number of frames, or None if the source does not tell.
    clock
        Monotonic time in seconds.
    """

    def __init__(
        self,
        live: Live,
        summary: RunSummary,
        total: int | None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._live, self._summary, self._total, self._clock = live, summary, total, clock
        self._next = self._begin = clock()
        self._doubts: deque[str] = deque(maxlen=_TOLD)

    def tick(self, estimate: PoseInterval) -> None:
        """Take a frame, and draw it if it is time; call this once per frame."""
        if estimate.status is not Status.OK:
            reasons = ", ".join(estimate.reasons)
            self._doubts.append(f"frame {estimate.seq} {estimate.status}: {reasons}")
        now = self._clock()
        if now >= self._next:
            self._next = now + _SECONDS_BETWEEN_UPDATES
            # Losing the terminal must not end the run.
            try:
                self._live.update(self.panel(estimate, now), refresh=True)
            except (OSError, ValueError):
                self._next = float("inf")

    def panel(self, estimate: PoseInterval, now: float) -> Text:
        """Return the lines for a frame at the time ``now``, of 80 columns at most."""
        from rich.text import Text

        shown = Text(no_wrap=True, overflow="ellipsis")
        unbounded = estimate.status is Status.OK and not estimate.vouched
        style = _STYLES[Status.DEGRADED if unbounded else estimate.status]
        shown.append(f"{estimate.status.upper():<9}", style=f"bold {style}")
        shown.append(f" {_cut(self._progress(now), _WIDTH - 10)}\n")
        shown.append(f"{_cut(_frame_line(estimate), _WIDTH)}\n")
        for line in _bars(estimate):
            shown.append(f"{line}\n", style=style)
        counts = "  ".join(f"{self._summary.statuses[each]} {each}" for each in Status)
        shown.append(f"{counts}  {self._summary.dropped} dropped\n")
        doubts = [*self._doubts, *[""] * (_TOLD - len(self._doubts))]
        shown.append("\n".join(_cut(line, _WIDTH) for line in doubts))
        return shown

    def _progress(self, now: float) -> str:
        level = f"{self._summary.confidence:g} {self._summary.scope}"
        return f"{done_text(self._summary, self._total, now - self._begin)}  {level}"


def _frame_line(estimate: PoseInterval) -> str:
    total = estimate.latency_ms.get("total")
    late = "" if total is None else f"{total:.1f} ms  "
    name = printable(estimate.source) or f"frame {estimate.seq}"
    if estimate.pose is None or not estimate.vouched:
        return f"{late}{name}"
    x, y, z = estimate.pose.t_m.tolist()
    return f"{x:.3f} {y:.3f} {z:.3f} m  {late}{name}"


def _bars(estimate: PoseInterval) -> list[str]:
    """Return two titles and six bars, or as many empty lines for a frame that has none."""
    if not estimate.vouched:
        why = ", ".join(estimate.reasons) or "unbounded"
        return [_cut(f"no interval: {why}", _WIDTH), *[""] * 7]
    pieces, lines = estimate.about_pose(), []
    for first, unit in ((0, "cm"), (3, "deg")):
        rows = [
            [(TO_CM_OR_DEG[dof] * low, TO_CM_OR_DEG[dof] * high) for low, high in pieces[dof]]
            for dof in range(first, first + 3)
        ]
        full = round_up(max(abs(end) for row in rows for piece in row for end in piece))
        lines.append(f"{'':<6}{f'-{full:g}':<{_BAR // 2}}0{f'{full:g} {unit}':>{_BAR // 2}}")
        for name, row in zip(estimate.chart.dof[first : first + 3], rows, strict=True):
            half = 0.5 * (row[-1][1] - row[0][0])
            gap = "*" if len(row) > 1 else ""
            lines.append(f"{name:<6}{_bar(row, full)} \u00b1{half:.{2 if half < 10 else 1}f}{gap}")
    return lines


def _bar(pieces: list[tuple[float, float]], full: float) -> str:
    middle = _BAR // 2
    cells = ["\u2500"] * _BAR
    for low, high in pieces:
        a, b = (middle + round(middle * value / full) for value in (low, high))
        cells[max(0, a) : b + 1] = ["\u2588"] * (b + 1 - max(0, a))
    cells[middle] = "\u253c" if cells[middle] == "\u2500" else "\u2502"
    return "".join(cells)


def _cut(text: str, room: int) -> str:
    return text if len(text) <= room else f"{text[: room - 1]}\u2026"


@contextmanager
def frames_preview(
    summary: RunSummary, total: int | None, *, records_here: bool
) -> Iterator[Callable[[PoseInterval], None]]:
    """Yield a function to call with each frame; it does nothing if stderr is not a terminal.

    ``records_here``: the records go to standard output, which then must be a pipe or a file.

    Raises UsageError for records on the same terminal.
    """
    if sys.stderr is None or not sys.stderr.isatty():
        yield lambda _: None
        return
    if records_here and sys.stdout is not None and sys.stdout.isatty():
        raise UsageError(
            "--preview: expected records in a file (-o FILE) or a pipe, found them on this terminal"
        )
    from rich.console import Console
    from rich.live import Live

    live = Live(
        console=Console(stderr=True), auto_refresh=False, redirect_stdout=False, transient=True
    )
    try:
        live.start()
        yield Preview(live, summary, total).tick
    finally:
        with suppress(OSError, ValueError):
            live.stop()
