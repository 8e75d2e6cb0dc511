"""The table of ``docs/vigilance.md`` that sums up what is promised with an alarm.

One column for each bundle of which anything was measured with an alarm, one row for each situation
of which anything was measured. Failures are named: each row gives the worst case as well.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from statistics import median
from typing import NamedTuple

from markdown_table import table
from vigilance_tables import (
    NOTHING,
    Report,
    digits,
    reports,
    same_room,
    title,
    wrong_shares,
)

STATE = "after"
# The reasons that the alarm gives; others are those of checks, e.g. of repeated pictures.
ALARM = ("image_unfamiliar", "image_degraded")
PROGRAMS = ("frames", "rooms", "noise", "alarms")
SAME_ROOM = "same room"
NO_PROOF = "-"

# Program -> reports of all seeds of one bundle; a program that was not run has none. The figures of
# rooms are those of other rooms, and under SAME_ROOM those of the bundle's own.
Measured = dict[str, list[Report]]


class Situation(NamedTuple):
    """A row: what is seen, what should happen, what is proven, and the figures if there are any."""

    name: str
    happens: str
    proven: str
    figures: Callable[[Measured], str | None]


def covered(measured: Measured) -> str | None:
    """Return the joint coverage of clean frames that have an interval."""
    found = [each["noises"]["none"]["with_alarm"] for each in measured["noise"]]
    if not found:
        return None
    share = median(each["joint_coverage"] for each in found)
    return f"covered {digits(share, 3)} (all six, 0.9)"


def without_interval(measured: Measured) -> str | None:
    """Return how many right frames have no interval, in long streams and in single ones."""
    parts = [
        f"no interval in {each['doubted']:,} of {each['frames']:,} frames, "
        f"{each['streams_with_doubts']} of {each['streams']} streams"
        for each in measured["alarms"]
    ]
    parts += _share_without(measured, lambda name: name == "clean")
    return "; ".join(parts) or None


def changed(measured: Measured) -> str | None:
    """Return the largest share without an interval after a harmless change."""
    return "; ".join(_share_without(measured, lambda name: name != "clean")) or None


def _share_without(measured: Measured, wanted: Callable[[str], bool]) -> list[str]:
    seeds = measured["frames"]
    if not seeds:
        return []
    lost = {
        name: (
            median(1.0 - each["harmless"][name]["finite"] for each in seeds),
            median(_alarmed(each["harmless"][name]) for each in seeds),
        )
        for name in seeds[0]["harmless"]
        if wanted(name)
    }
    name, (share, alarmed) = max(lost.items(), key=lambda item: item[1][0])
    return [f"no interval in {digits(share)} ({name}), by the alarm {digits(alarmed)}"]


def _alarmed(figures: Report) -> float:
    return sum(share for reason, share in figures["reasons"].items() if reason in ALARM)


def noise(measured: Measured) -> str | None:
    """Return how many noisy frames have an interval, and the largest share that it misses."""
    seeds = measured["noise"]
    if not seeds:
        return None
    given = {
        name: [each["noises"][name]["with_alarm"] for each in seeds]
        for name in seeds[0]["noises"]
        if name != "none"
    }
    finite = [median(each["finite"] for each in found) for found in given.values()]
    missed = {name: median(map(_missed, found)) for name, found in given.items()}
    return f"interval {_range(finite)}; {_worst(missed, 'missed')}"


def _missed(figures: Report) -> float:
    """Return the share of all frames whose finite interval misses the truth in any DoF."""
    if not figures["finite"]:
        return 0.0
    return float(figures["finite"] * (1.0 - figures["joint_coverage"]))


def _in_rooms(measured: Measured, place: str, figure: str) -> dict[str, float]:
    seeds = measured[place]
    names = dict.fromkeys(name for each in seeds for name in each)
    return {name: median(each[name][figure] for each in seeds if name in each) for name in names}


def rooms(measured: Measured) -> str | None:
    """Return how many frames of other rooms have an interval."""
    shares = _in_rooms(measured, "rooms", "finite")
    if not shares:
        return None
    name, share = max(shares.items(), key=lambda item: item[1])
    return f"interval: at most {digits(share, 3)} ({name})"


def same_rooms(measured: Measured) -> str | None:
    """Return how many frames of the bundle's room by another camera have an interval."""
    shares = _in_rooms(measured, SAME_ROOM, "finite")
    if not shares:
        return None
    wrong = _in_rooms(measured, SAME_ROOM, "wrong")
    return f"interval {_range(shares.values())}; {_worst(wrong)}"


def family(name: str) -> Callable[[Measured], str | None]:
    """Return what gives the median and the worst kind of one family of wrong frames."""

    def figures(measured: Measured) -> str | None:
        if not measured["frames"]:
            return None
        shares = wrong_shares(measured["frames"], name)
        return f"median {digits(median(shares.values()))}; {_worst(shares)}" if shares else None

    return figures


def hinted(measured: Measured) -> str | None:
    """Return the worst frozen kind with the hint that the camera moves."""
    seeds = measured["frames"]
    names = seeds[0]["hinted"] if seeds else ()
    shares = {
        name.removesuffix(", with the hint"): median(
            each["hinted"][name]["wrong"] for each in seeds
        )
        for name in names
    }
    return _worst(shares) if shares else None


def _range(shares: Iterable[float]) -> str:
    values = list(shares)
    least, most = digits(min(values)), digits(max(values))
    return least if len(values) == 1 else f"{least} to {most}"


def _worst(shares: dict[str, float], word: str = "wrong") -> str:
    name, share = max(shares.items(), key=lambda item: item[1])
    return f"{word} at most {digits(share)}" + (f" ({name})" if share else "")


DOUBT = "no interval, or one that holds"
SITUATIONS = (
    Situation("right frames", "an interval that holds", "[the guarantee](guarantee.md)", covered),
    Situation(
        "right frames: false alarms",
        "an interval",
        "[at most](guarantee.md#the-alarm) 1 % of known frames beyond a limit (`random`); a new "
        "recording with probability at most 5 / (G + 1) (`sequence`)",
        without_interval,
    ),
    Situation("right frames, harmlessly changed", "an interval", NO_PROOF, changed),
    Situation("noise of the study", DOUBT, NO_PROOF, noise),
    Situation("another room", "no interval", NO_PROOF, rooms),
    Situation("the same room, another camera", DOUBT, NO_PROOF, same_rooms),
    Situation(
        "wrong frames: frozen",
        "no interval; a still with fresh noise passes as a camera at rest",
        NO_PROOF,
        family("frozen"),
    ),
    Situation("frozen, and the hint that the camera moves", "no interval", NO_PROOF, hinted),
    *(
        Situation(f"wrong frames: {name}", DOUBT, NO_PROOF, family(name))
        for name in ("geometry", "torn", "colour and format", "sensor", "optics", "no picture")
    ),
)


def promised() -> str:
    """Return what should happen in each situation and how often it did, for each bundle."""
    bundles: dict[str, Measured] = {}
    for program in PROGRAMS:
        for bundle, states in reports(program).items():
            if states.get(STATE):
                empty: Measured = {each: [] for each in (*PROGRAMS, SAME_ROOM)}
                bundles.setdefault(bundle, empty)[program] = states[STATE]
    # Those that nothing but noise was shown to have a table of their own.
    others = [program for program in PROGRAMS if program != "noise"]
    bundles = {
        bundle: measured
        for bundle, measured in bundles.items()
        if any(measured[program] for program in others)
    }
    if not bundles:
        return NOTHING
    heads = [title(bundle, measured) for bundle, measured in bundles.items()]
    for bundle, measured in bundles.items():
        seeds = [each["rooms"] for each in measured["rooms"]]
        for place, same in (("rooms", False), (SAME_ROOM, True)):
            measured[place] = [
                {name: room for name, room in each.items() if same_room(bundle, name) is same}
                for each in seeds
            ]
    rows = []
    for each in SITUATIONS:
        cells = [each.figures(measured) for measured in bundles.values()]
        if any(cells):
            rows.append([each.name, each.happens, each.proven, *(cell or "-" for cell in cells)])
    return table(["situation", "what should happen", "proven", *heads], rows)


TABLES: dict[str, Callable[[], str]] = {"vigilance-promised": promised}
