"""How wrong frames are chosen and counted, by hand-made estimates."""

import sys
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "bench"))

import promised_table
import vigilance_tables
from alarms import false_alarms
from wrong_frames import shares, streams_of, summary


@dataclass
class Estimate:
    bounded: bool
    reasons: tuple = ()


@dataclass
class Seen:
    finite: bool
    misplaced: bool
    reasons: tuple = ()

    @property
    def estimate(self):
        return self


@pytest.mark.parametrize("lengths", [[200], [50] * 12, [30, 7, 60, 45], [60] * 3])
@pytest.mark.parametrize("start", [0, 10, 40])
def test_streams_hold_the_frames_asked_for_after_their_right_ones(lengths, start):
    borders = np.cumsum([0, *lengths])
    rows = [np.arange(a, b) for a, b in pairwise(borders.tolist())]
    streams = list(streams_of(rows, start, 100))
    assert len({stream[0] for stream in streams}) == len(streams)
    for stream in streams:
        assert stream[0] in borders
        assert len(stream) > start
        np.testing.assert_array_equal(np.diff(stream), 1)
    faulty = sum(len(stream) - start for stream in streams)
    assert faulty == min(100, sum(max(0, length - start) for length in lengths))


def test_shares_are_of_all_frames():
    seen = [Seen(True, True), Seen(True, False), Seen(False, False, ("image_black",))] * 2
    found = shares([*seen, Seen(False, False), Seen(False, False)])
    assert found == {
        "frames": 8,
        "wrong": 0.25,
        "finite": 0.5,
        "reasons": {"image_black": 0.25},
    }


def test_unchanged_kinds_count_nowhere():
    wrong = [(0.0, True), (0.12, True), (0.9, True), (1.0, False)]
    found = summary({"wrong": share, "changed": changed} for share, changed in wrong)
    assert found == {"kinds": 3, "median": 0.12, "over_0.10": 2, "over_0.15": 1, "worst": 0.9}


def test_episodes_are_runs_and_end_with_a_stream():
    doubt, right = Estimate(False, ("frame_repeated",)), Estimate(True)
    found = false_alarms([[doubt, doubt, right, doubt], [doubt, right], [right, right]])
    assert found == {
        "frames": 8,
        "streams": 3,
        "doubted": 4,
        "reasons": {"frame_repeated": 4},
        "episodes": 3,
        "longest_episode": 2,
        "streams_with_doubts": 2,
    }


def test_tables_say_where_nothing_was_measured(monkeypatch):
    monkeypatch.setattr(vigilance_tables, "result_files", lambda _: [])
    assert {make() for make in vigilance_tables.TABLES.values()} == {vigilance_tables.NOTHING}


def _frames(wrong, finite):
    kinds = {"torn": ("torn", wrong), "two": ("torn", 0.0), "still": ("frozen", 0.9)}
    reasons = {"frame_repeated": 0.1, "image_degraded": 0.3}
    return {
        "situation": "known frames",
        "wrong": {
            name: {"family": family, "changed": True, "wrong": share}
            for name, (family, share) in kinds.items()
        },
        "hinted": {},
        "harmless": {
            "clean": {"finite": 1.0, "reasons": {}},
            "darker": {"finite": finite, "reasons": reasons},
        },
    }


def _noise(finite, coverage):
    given = {"none": (1.0, 0.9), "speckle": (finite, coverage), "exposure": (0.0, None)}
    return {
        "noises": {
            name: {"with_alarm": {"finite": share, "joint_coverage": covered}}
            for name, (share, covered) in given.items()
        }
    }


def test_the_false_alarms_are_those_of_bundles_with_an_alarm(monkeypatch):
    report = {"doubted": 3, "frames": 8, "episodes": 2, "streams_with_doubts": 1, "streams": 4}
    states = {"before": [{**report, "reasons": {}}]}
    monkeypatch.setattr(vigilance_tables, "reports", lambda _: {"a": states})
    assert vigilance_tables.false_alarms() == vigilance_tables.NOTHING
    states["after"] = [{**report, "reasons": {"image_degraded": 3}}]
    *_, row = vigilance_tables.false_alarms().splitlines()
    assert row == "| a | 3 of 8 | 2 | 1 of 4 | image_degraded 3 |"


def test_the_promises_name_the_worst_of_what_was_measured_with_an_alarm(monkeypatch):
    found = {
        "frames": {
            "a": {"before": [_frames(1.0, 1.0)], "after": [_frames(0.2, 0.6)]},
            "b": {"before": [_frames(1.0, 1.0)]},
        },
        "rooms": {
            "c": {"after": [{"rooms": {"x": {"finite": 0.0}, "y": {"finite": 0.03}}}]},
            "flights-d": {"after": [{"rooms": {"redkitchen": {"finite": 1.0, "wrong": 0.25}}}]},
        },
        "noise": {"c": {"after": [_noise(0.5, 0.75)]}, "only": {"after": [_noise(1.0, 0.1)]}},
    }
    monkeypatch.setattr(promised_table, "reports", lambda program: found.get(program, {}))
    head, _, *rows = promised_table.promised().splitlines()
    assert head == "| situation | what should happen | proven | a (known frames) | c | flights-d |"
    cells = {row.split(" | ")[0].removeprefix("| "): row.split(" | ")[3:] for row in rows}
    assert cells == {
        "right frames": ["-", "covered .900 (all six, 0.9)", "- |"],
        "right frames: false alarms": [
            "no interval in .00 (clean), by the alarm .00",
            *("-", "- |"),
        ],
        "right frames, harmlessly changed": [
            "no interval in .40 (darker), by the alarm .30",
            *("-", "- |"),
        ],
        "noise of the study": ["-", "interval .00 to .50; missed at most .12 (speckle)", "- |"],
        "another room": ["-", "interval: at most .030 (y)", "- |"],
        "the same room, another camera": [
            *("-", "-"),
            "interval 1.00; wrong at most .25 (redkitchen) |",
        ],
        "wrong frames: frozen": ["median .90; wrong at most .90 (still)", "-", "- |"],
        "wrong frames: torn": ["median .10; wrong at most .20 (torn)", "-", "- |"],
    }
    del found["frames"]["a"]["after"], found["rooms"], found["noise"]
    assert promised_table.promised() == vigilance_tables.NOTHING
