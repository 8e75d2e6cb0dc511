"""Tables of ``results/service`` for ``bench/tables.py``."""

from __future__ import annotations

import re
from collections.abc import Callable

from markdown_table import table
from provenance import read_result


def day() -> str:
    """Return a row for each event of the simulated day, with what the service said."""
    found = read_result("service", "day")
    rows = [
        [f"{event['hour']:.1f}", event["event"], "; ".join(map(_shown, event["said"]))]
        for event in found["events"]
    ]
    return table(("hour", "event", "what the service said"), rows)


def _shown(line: str) -> str:
    """Return a line without the address of the camera."""
    line = re.sub(r"http://\S+?: ", "", line)
    return f"`{line}`"


def day_account() -> str:
    """Return a row for each process of the day."""
    found = read_result("service", "day")
    keys = ("delivered", "dropped_frames", "dropped_records", "records_read", "unsaid")
    rows = [
        [str(number), *(str(life[key]) for key in keys)]
        for number, life in enumerate(found["lives"], start=1)
    ]
    head = ("process", "frames delivered", "dropped for newer ones", "dropped on the full disk")
    return table((*head, "records read back", "losses unsaid"), rows)


def day_checks() -> str:
    """Return what was checked beside the accounts."""
    found = read_result("service", "day")
    ages, watchdog = found["ages"], found["watchdog"]
    rows = [
        ["frames of the first connection, in which the process is stopped", str(ages["frames"])],
        ["of them older than 1.1 s when their estimate was given", str(ages["older than 1.1 s"])],
        ["of those with status `ok`", str(ages["older and ok"])],
        [
            "longest time between two `WATCHDOG=1` while the process was not stopped",
            f"{watchdog['longest_s']:.1f} s of {watchdog['limit_s']:.0f} s",
        ],
        ["exit codes", " ".join(map(str, found["exit_codes"]))],
    ]
    return table(("what", "found"), rows)


def four_cameras() -> str:
    """Return a row for each way to serve four cameras, and each bundle."""
    found = read_result("service", "four_cameras")
    rows = []
    for run in found["runs"]:
        cameras = run["cameras"]
        counts = [each["frames"] for each in cameras]
        rows.append(
            [
                f"{run['way']}, {run['method']} {run['precision']}, {run['fps']:g} fps",
                " ".join(str(each["delivered"]) for each in cameras),
                " ".join(map(str, counts)),
                " ".join(str(each["dropped_frames"]) for each in cameras),
                str(sum(each["unsaid"] for each in cameras)),
                f"{min(counts) / max(counts):.2f}",
                " ".join(f"{each['p50_ms']:.0f}" for each in cameras),
                " ".join(f"{each['p99_ms']:.0f}" for each in cameras),
                f"{run['cores_used']:.2f}",
            ]
        )
    head = ("way", "delivered", "estimated", "dropped for newer ones", "unsaid", "min/max")
    return table((*head, "p50 ms", "p99 ms", "cores used"), rows)


TABLES: dict[str, Callable[[], str]] = {
    "day": day,
    "day account": day_account,
    "day checks": day_checks,
    "four cameras": four_cameras,
}
