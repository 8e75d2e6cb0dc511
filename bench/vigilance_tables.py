"""Tables of ``results/vigilance`` for ``bench/tables.py``: wrong input, before and with an alarm.

A file is named STATE-PROGRAM-BUNDLE.json, for several seeds STATE-PROGRAM-BUNDLE-SEED.json: STATE
is ``before`` or ``after``, PROGRAM ``frames``, ``rooms``, ``noise`` or ``alarms``. Figures are
medians over seeds. A table of which nothing has been measured says so.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from markdown_table import table
from provenance import read_result, result_files

FOLDER = "vigilance"
STATES = ("before", "after")
NAME = re.compile(r"(?P<state>before|after)-(?P<program>[a-z]+)-(?P<bundle>.+?)(?:-\d+)?")
NOTHING = "Not measured yet."
# One room and world frame: kitchen_flights is rendered from a reconstruction of redkitchen.
KITCHEN = ("flights", "kitchen_flights", "redkitchen")
# Kinds that the table of the worst names.
WORST, OVER = 10, 0.15

Report = dict[str, Any]
# The result of bench/temporal.py, which needs no bundle.
TEMPORAL = "temporal"
# Bundle -> state -> reports of all seeds.
Found = dict[str, dict[str, list[Report]]]


def reports(program: str) -> Found:
    """Return the results of one program."""
    found: Found = defaultdict(lambda: defaultdict(list))
    for path in result_files(FOLDER):
        if path.stem == TEMPORAL:
            continue
        match = NAME.fullmatch(path.stem)
        if match is None:
            raise KeyError(f"{path.name}: expected a name of the form STATE-PROGRAM-BUNDLE")
        if match["program"] == program:
            found[match["bundle"]][match["state"]].append(read_result(FOLDER, path.stem))
    return found


def median(values: Iterable[float | None]) -> float | None:
    """Return the median of the values that exist, or None."""
    known = [value for value in values if value is not None]
    return float(np.median(known)) if known else None


def digits(value: float | None, count: int = 2) -> str:
    """A share without its leading zero."""
    return "-" if value is None else f"{value:.{count}f}".removeprefix("0")


def title(bundle: str, states: dict[str, list[Report]]) -> str:
    """Return a bundle's name and its situation, if any of its reports states it."""
    situations = (each.get("situation") for seeds in states.values() for each in seeds)
    situation = next((each for each in situations if each), None)
    return f"{bundle} ({situation})" if situation else bundle


def _columns(found: Found) -> list[tuple[str, list[Report]]]:
    """Return a heading and the reports of each bundle and state."""
    return [
        (f"{bundle}, {state}", states[state])
        for bundle, states in found.items()
        for state in STATES
        if state in states
    ]


def wrong_frames() -> str:
    """Return how many kinds of wrong frames get finite and wrong intervals, for each bundle."""
    rows = []
    for bundle, states in (found := reports("frames")).items():
        for state in STATES:
            if state not in states:
                continue
            for group, label in (("all", "all kinds"), ("left_out", "left out of any fit")):
                summaries = [report["summary"][group] for report in states[state]]
                rows.append([title(bundle, states), state, label, *_summary(summaries)])
    if not found:
        return NOTHING
    return table(["bundle", "", "kinds", "number", "median", "over .10", "over .15", "worst"], rows)


def _summary(summaries: list[Report]) -> list[str]:
    over = [f"{median(s[f'over_{limit}'] for s in summaries):g}" for limit in ("0.10", "0.15")]
    shares = [digits(median(s[key] for s in summaries), 3) for key in ("median", "worst")]
    return [f"{summaries[0]['kinds']}", shares[0], *over, shares[1]]


def wrong_shares(seeds: list[Report], family: str | None = None) -> dict[str, float]:
    """Return the share that is finite and wrong by kind, the median over seeds."""
    kinds = {
        name: figures
        for name, figures in seeds[0]["wrong"].items()
        if figures["changed"] and family in (None, figures["family"])
    }
    return {
        name: float(np.median([report["wrong"][name]["wrong"] for report in seeds]))
        for name in kinds
    }


def families() -> str:
    """Return the median and the number of kinds over .15, by family."""
    columns = _columns(reports("frames"))
    if not columns:
        return NOTHING
    names = dict.fromkeys(
        figures["family"] for _, seeds in columns for figures in seeds[0]["wrong"].values()
    )
    rows = []
    for name in names:
        row = [name]
        for _, seeds in columns:
            shares = list(wrong_shares(seeds, name).values())
            over = sum(share > OVER for share in shares)
            row.append(f"{digits(median(shares))}; {over} of {len(shares)}")
        rows.append(row)
    return table(["median; kinds over .15", *(head for head, _ in columns)], rows)


def worst() -> str:
    """Return the kinds with the largest shares, for each bundle."""
    columns = _columns(reports("frames"))
    if not columns:
        return NOTHING
    rows = []
    for head, seeds in columns:
        shares = sorted(wrong_shares(seeds).items(), key=lambda item: -item[1])
        full = sum(share == shares[0][1] for _, share in shares)
        if full > WORST:
            rows.append([head, f"{full} kinds {digits(shares[0][1])}"])
            continue
        shown = (f"{name} {digits(share)}" for name, share in shares[:WORST])
        rows.append([head, ", ".join(shown)])
    return table(["bundle", "worst kinds"], rows)


def hinted() -> str:
    """Return the kinds of one still image, without and with the hint that the camera moves."""
    rows = []
    for head, seeds in _columns(reports("frames")):
        for name in seeds[0]["hinted"]:
            plain = name.removesuffix(", with the hint")
            without = median(report["wrong"][plain]["wrong"] for report in seeds)
            share = median(report["hinted"][name]["wrong"] for report in seeds)
            rows.append([head, plain, digits(without), digits(share)])
    return table(["bundle", "kind", "without the hint", "with it"], rows) if rows else NOTHING


def harmless() -> str:
    """Return the share of frames without an interval after each harmless change."""
    columns = _columns(reports("frames"))
    if not columns:
        return NOTHING
    rows = [
        [
            name,
            *(
                digits(median(1.0 - report["harmless"][name]["finite"] for report in seeds))
                for _, seeds in columns
            ),
        ]
        for name in columns[0][1][0]["harmless"]
    ]
    return table(["share of frames without an interval", *(head for head, _ in columns)], rows)


def same_room(bundle: str, room: str) -> bool:
    """Whether a data set shows the room that a bundle was made in, in the same world frame."""
    return room in KITCHEN and bundle.split("-")[0] in KITCHEN


def rooms() -> str:
    """Return the share of finite intervals in other rooms."""
    rows = []
    for bundle, states in reports("rooms").items():
        names = dict.fromkeys(
            room for seeds in states.values() for each in seeds for room in each["rooms"]
        )
        rows += [
            [
                bundle,
                f"{name} (the same room)" if same_room(bundle, name) else name,
                *(_room(states.get(state, []), name) for state in STATES),
            ]
            for name in names
        ]
    return table(["bundle", "room", *STATES], rows) if rows else NOTHING


def _room(seeds: list[Report], name: str) -> str:
    found = [report["rooms"][name] for report in seeds if name in report["rooms"]]
    if not found:
        return "-"
    shares = [share for each in found for share in each["recordings"].values()]
    text = digits(median(each["finite"] for each in found), 3)
    if len(shares) == 1:
        return text
    return f"{text}; recordings {digits(min(shares))} to {digits(max(shares))}"


def noise() -> str:
    """Return coverage and width with each noise, the alarm ignored and with it."""
    rows = []
    for bundle, states in (found := reports("noise")).items():
        for state in STATES:
            for name in states[state][0]["noises"] if state in states else ():
                entries = [report["noises"][name] for report in states[state]]
                rows.append([title(bundle, states), state, name, *_noise(entries)])
    if not found:
        return NOTHING
    return table(
        [
            *("bundle", "", "noise", "alarm ignored: coverage per DoF", "joint", "width"),
            *("over the oracle's", "with the alarm: finite", "joint coverage"),
        ],
        rows,
    )


def _noise(entries: list[Report]) -> list[str]:
    ignored = [entry["ignored"] for entry in entries if entry["ignored"]["frames"]]
    given = [entry["with_alarm"] for entry in entries]
    width = median(100 * float(np.mean(each["mean_width"][:3])) for each in ignored)
    over = median(each["over_oracle"] for each in ignored)
    return [
        digits(median(float(np.mean(each["coverage"])) for each in ignored), 3),
        digits(median(each["joint_coverage"] for each in ignored), 3),
        "-" if width is None else f"{width:.1f} cm",
        "-" if over is None else f"{over:.2f} x",
        digits(median(each["finite"] for each in given), 3),
        digits(median(each["joint_coverage"] for each in given), 3),
    ]


def false_alarms() -> str:
    """Return the frames without an interval in long streams of right frames, with an alarm."""
    rows = []
    for bundle, states in reports("alarms").items():
        for report in states.get("after", ()):
            reasons = (f"{reason} {n:,}" for reason, n in report["reasons"].items())
            rows.append(
                [
                    title(bundle, states),
                    f"{report['doubted']:,} of {report['frames']:,}",
                    f"{report['episodes']:,}",
                    f"{report['streams_with_doubts']} of {report['streams']}",
                    ", ".join(reasons) or "-",
                ]
            )
    head = ["bundle", "frames without an interval", "episodes", "streams with one", "reasons"]
    return table(head, rows) if rows else NOTHING


TABLES: dict[str, Callable[[], str]] = {
    "vigilance-frames": wrong_frames,
    "vigilance-families": families,
    "vigilance-worst": worst,
    "vigilance-hinted": hinted,
    "vigilance-harmless": harmless,
    "vigilance-rooms": rooms,
    "vigilance-noise": noise,
    "vigilance-alarms": false_alarms,
}
