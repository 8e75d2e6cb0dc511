"""The panel of a run: what it shows of each frame, in 80 columns, at most five times a second."""

import io
import sys
from dataclasses import replace

import pytest
from rich.console import Console
from rich.live import Live

from cvo_edge.errors import UsageError
from cvo_edge.programs.preview import Preview, frames_preview

from .test_overlay import DEGRADED, HALF_OPEN, INVALID, OK
from .test_progress import Clock, Terminal, summary_of

LONG = replace(OK, source="a very long name of a frame " * 5, latency_ms={"total": 12345.678})


def preview(stream, clock):
    console = Console(file=stream, force_terminal=True, width=80, _environ={})
    live = Live(console=console, auto_refresh=False, transient=True)
    return Preview(live, summary_of(ok=70, degraded=5), 300, clock)


@pytest.mark.parametrize("estimate", [OK, HALF_OPEN, DEGRADED, INVALID, LONG])
def test_only_a_frame_that_is_vouched_for_shows_pose_and_bars(estimate):
    clock = Clock()
    panel = preview(io.StringIO(), clock)
    panel.tick(estimate)
    clock.now += 5.0
    lines = panel.panel(estimate, clock.now).plain.split("\n")
    assert len(lines) == 14
    assert max(map(len, lines)) <= 80
    assert "75 of 300 frames (25%)  15.0 fps  0:15 left  0.9 marginal" in lines[0]
    assert lines[10] == "70 ok  5 degraded  0 invalid  0 dropped"
    shown = "\n".join(lines)
    assert ("\u2588" in shown) == ("1.000 2.000 3.000 m" in shown) == estimate.vouched
    assert ("no interval: " in shown) != estimate.vouched
    if estimate is DEGRADED:
        assert lines[11] == "frame 7 degraded: frame_stale, image_grey"


def test_bars_are_half_widths_about_the_pose():
    lines = preview(io.StringIO(), Clock()).panel(OK, 101.0).plain.split("\n")
    assert [line.split("\u00b1")[1] for line in lines if "\u00b1" in line] == (
        ["2.00", "1.00", "3.00", "0.46", "0.34", "0.57"]
    )
    # 2 of 5 cm, in cells left and right of the middle.
    assert lines[3].count("\u2588") == 20


def test_it_is_drawn_at_most_five_times_a_second_and_survives_a_lost_terminal():
    clock, stream = Clock(), io.StringIO()
    panel = preview(stream, clock)
    for _ in range(1000):
        panel.tick(OK)
        clock.now += 0.001
    assert stream.getvalue().count("fps") <= 6
    stream.close()
    clock.now += 1.0
    panel.tick(OK)


def test_it_needs_a_terminal_of_its_own(monkeypatch):
    monkeypatch.setattr(sys, "stderr", io.StringIO())
    with frames_preview(summary_of(), None, records_here=True) as tick:
        tick(OK)
    assert sys.stderr.getvalue() == ""
    monkeypatch.setattr(sys, "stderr", Terminal())
    monkeypatch.setattr(sys, "stdout", Terminal())
    refused = pytest.raises(UsageError, match="--preview: expected records in a file")
    with refused, frames_preview(summary_of(), None, records_here=True):
        pass
    with frames_preview(summary_of(ok=1), None, records_here=False) as tick:
        tick(OK)
    assert sys.stdout.getvalue() == ""
    assert "1.000 2.000 3.000 m" in sys.stderr.getvalue()
