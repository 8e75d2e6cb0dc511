"""The progress line of a run: its content, its rate, and that it is erased completely."""

import io
import sys

import pytest

from cvo_edge.programs.progress import FramesProgress, frames_progress
from cvo_edge.programs.run import RunSummary

CLEAR = "\r\x1b[K"


class Clock:
    def __init__(self):
        self.now = 100.0

    def __call__(self):
        return self.now


class Terminal(io.StringIO):
    def isatty(self):
        return True


def summary_of(**statuses):
    summary = RunSummary(("tx", "ty", "tz", "rx", "ry", "rz"), 0.9, "marginal")
    summary.statuses.update(statuses)
    return summary


def test_it_tells_frames_rate_time_left_and_statuses():
    progress = FramesProgress(io.StringIO(), summary_of(ok=70, degraded=5), 300, Clock())
    assert progress.line(105.0) == (
        "75 of 300 frames (25%)  15.0 fps  0:15 left  70 ok  5 degraded"
    )


def test_without_a_length_it_tells_no_share_and_no_time_left():
    progress = FramesProgress(io.StringIO(), summary_of(ok=75), None, Clock())
    assert progress.line(105.0) == "75 frames  15.0 fps  75 ok"


def test_dropped_frames_count_as_done_and_not_in_the_rate():
    summary = summary_of(ok=50)
    summary.dropped = 50
    progress = FramesProgress(io.StringIO(), summary, 200, Clock())
    assert progress.line(110.0).startswith("100 of 200 frames (50%)  5.0 fps  0:10 left")


def test_a_file_longer_than_its_header_says_is_at_most_all():
    progress = FramesProgress(io.StringIO(), summary_of(ok=30), 20, Clock())
    assert progress.line(103.0).startswith("30 of 20 frames (100%)  10.0 fps  0:00 left")


def test_it_is_written_at_most_ten_times_a_second_and_removed_at_the_end():
    clock, stream = Clock(), io.StringIO()
    progress = FramesProgress(stream, summary_of(ok=1), None, clock)
    for _ in range(1000):
        clock.now += 0.001
        progress.tick()
    lines = stream.getvalue().split(CLEAR)[1:]
    assert 9 <= len(lines) <= 10
    progress.close()
    assert stream.getvalue().endswith(CLEAR)


def test_a_run_shorter_than_an_update_writes_nothing():
    stream = io.StringIO()
    progress = FramesProgress(stream, summary_of(ok=1), 1, Clock())
    progress.tick()
    progress.close()
    assert stream.getvalue() == ""


def test_a_terminal_that_has_gone_does_not_end_the_run():
    class Gone(io.StringIO):
        def write(self, text):
            raise OSError

    clock = Clock()
    progress = FramesProgress(Gone(), summary_of(ok=1), None, clock)
    clock.now += 1.0
    progress.tick()
    progress.close()
    assert progress.line(clock.now) == "1 frames  1.0 fps  1 ok"


@pytest.mark.parametrize(
    ("stream", "wanted"), [(Terminal(), False), (io.StringIO(), True), (None, True)]
)
def test_nothing_is_shown_where_nobody_wants_or_sees_it(monkeypatch, stream, wanted):
    monkeypatch.setattr(sys, "stderr", stream)
    with frames_progress(wanted, summary_of(), 10) as tick:
        tick()
        assert not hasattr(tick, "__self__")
    assert stream is None or stream.getvalue() == ""


@pytest.mark.parametrize("error", [KeyboardInterrupt, ValueError])
def test_the_line_is_removed_also_on_an_interrupt_or_an_error(monkeypatch, error):
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)

    def watched_run():
        with frames_progress(True, summary_of(ok=4), 8) as tick:
            tick.__self__._next = 0.0
            tick()
            raise error

    with pytest.raises(error):
        watched_run()
    assert "4 of 8 frames" in terminal.getvalue()
    assert terminal.getvalue().endswith(CLEAR)
