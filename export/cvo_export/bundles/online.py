"""Coverage of thresholds that adapt to labels, on frames that are played in order.

The stages are the frames as they are, with a noise, and as they are again; the thresholds do not
know when a stage begins. Few frames are played several times, so that a stage outlasts the change.
"""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cvo_edge.bundle.format import Calibration
from cvo_edge.bundle.quantiles import threshold_at
from cvo_edge.engine.observation import Observation
from cvo_edge.errors import UsageError
from cvo_edge.monitor.adaptation import KEPT, Adaptation
from cvo_edge.monitor.steps import error_bound, step
from cvo_edge.odometer import Odometer
from cvo_edge.vocabulary import SCOPES, Scope
from cvo_export.bundles.observed import Observed

Array = NDArray[np.float64]

CONFIDENCE = 0.9
# Least number of frames in a stage; windows of frames since the last change: first and end.
_LEAST = 600
WINDOWS: tuple[tuple[int, int | None], ...] = ((0, 100), (100, 300), (300, None))


@dataclass(frozen=True)
class Schedule:
    """A label for every ``every``-th frame, ``delay`` frames late; ``str`` is what is parsed."""

    every: int
    delay: int

    def __str__(self) -> str:
        return f"every={self.every},delay={self.delay}"

    @property
    def eta(self) -> float:
        """The step of every label but the first, whose gap counts as one frame."""
        return step(self.every, self.delay)


def parse_schedule(text: str) -> Schedule:
    """Read ``every=K,delay=D``; raises UsageError for any other text."""
    found = re.fullmatch(r"every=([0-9]{1,6}),delay=([0-9]{1,6})", text)
    if not found or int(found[1]) < 1 or int(found[2]) >= KEPT:
        raise UsageError(
            f"online: expected every=K,delay=D with K of at least 1 and D of at most {KEPT - 1}, "
            f"found {text!r}"
        )
    return Schedule(int(found[1]), int(found[2]))


class Stage(NamedTuple):
    """The numbers of the frames of a stage, and what the runtime observed on them."""

    name: str
    indices: NDArray[np.int64]
    seen: Observed


def online(
    odometer: Odometer,
    calibration: Calibration,
    poses: Array,
    stages: Sequence[Stage],
    schedule: Schedule,
) -> dict[str, Any]:
    """Return the report: coverage at 0.9 without labels and with a schedule, for both scopes.

    ``poses`` (n, 7) are the true poses of the data set, by frame number.

    Raises UsageError if the thresholds of a scope are unbounded.
    """
    times = -(-_LEAST // len(stages[0].indices))
    stages = [stage._replace(indices=np.tile(stage.indices, times)) for stage in stages]
    rows = [
        _played(odometer, calibration, poses, stages, scope, labels)
        for scope in SCOPES
        for labels in (None, schedule)
    ]
    return {
        **asdict(schedule),
        "eta": schedule.eta,
        "confidence": CONFIDENCE,
        "frames": len(stages[0].indices),
        "times": times,
        "rows": rows,
    }


def _played(
    odometer: Odometer,
    calibration: Calibration,
    poses: Array,
    stages: Sequence[Stage],
    scope: Scope,
    schedule: Schedule | None,
) -> dict[str, Any]:
    head = odometer.head
    start = threshold_at(calibration, CONFIDENCE, scope)
    adaptation = Adaptation(head, odometer.chart, calibration, start)
    coming: deque[tuple[int, Array]] = deque()
    missed: list[float] = []
    found, seq = [], -1
    for stage in stages:
        seen = stage.seen
        row_of = {index: row for row, index in enumerate(seen.indices.tolist())}
        calibrated = seen.sets(head, start)
        covered = np.full(len(stage.indices), np.nan)
        wider = []
        for number, index in enumerate(stage.indices.tolist()):
            seq += 1
            row, level = row_of.get(index), adaptation.level
            if row is None:
                # A check has flagged the frame; its label, if any, changes nothing.
                adaptation.remember(seq, level, None)
            else:
                outputs = {name: values[row : row + 1] for name, values in seen.outputs.items()}
                point, truth = seen.point[row], seen.truth[row]
                got = calibrated[row]
                if schedule is not None:
                    got = head.conformal_set(outputs, point, level.threshold)
                covered[number] = (
                    got.contains(truth) if scope == "joint" else got.covers(truth).mean()
                )
                wider.append(got.width() / calibrated[row].width())
                adaptation.remember(seq, level, Observation(outputs, seen.pose[row], point))
                if schedule is not None and seq % schedule.every == 0:
                    coming.append((seq, poses[index]))
            while schedule is not None and coming and coming[0][0] <= seq - schedule.delay:
                inside = adaptation.update(*coming.popleft()).covered
                missed.append(1.0 - float(np.mean(inside or ())))
        found.append(
            {
                "stage": stage.name,
                "windows": [_share(covered[first:end]) for first, end in WINDOWS],
                "width_ratio": float(np.nanmean(wider)) if wider else None,
                "factor": list(adaptation.level.factor),
            }
        )
    report: dict[str, Any] = {"scope": scope, "labels": len(missed), "stages": found}
    if schedule is not None and missed:
        bound = error_bound(len(missed), schedule.eta, schedule.delay / schedule.every)
        report |= {"labelled_missed": float(np.mean(missed)), "bound": bound}
    return report


def _share(covered: Array) -> dict[str, Any]:
    """Return the number of frames with an interval, and the share that is covered or None."""
    known = covered[~np.isnan(covered)]
    return {"frames": known.size, "coverage": float(known.mean()) if known.size else None}


def online_lines(report: Mapping[str, Any]) -> list[str]:
    """Return the report as lines of readable text."""
    rows = report["rows"]
    stages = rows[0]["stages"]
    windows = "".join(f"{f'{first}-{end}' if end else 'later':>8}" for first, end in WINDOWS)
    lines = [
        f"online: {report['frames']} frames a stage"
        + (f", all frames {report['times']} times" if report["times"] > 1 else "")
        + f"; coverage at {report['confidence']:g} by frames since the change (marginal: mean of "
        "six), mean width over the calibrated one",
        f"{'':<28}" + "".join(f"{stage['stage']:^32}" for stage in stages),
        f"{'scope':<10}{'labels':<18}" + f"{windows}{'width':>8}" * len(stages),
    ]
    schedule = Schedule(report["every"], report["delay"])
    for row in rows:
        cells = ""
        for stage in row["stages"]:
            shares = [window["coverage"] for window in stage["windows"]]
            cells += "".join(f"{'-' if share is None else f'{share:.3f}':>8}" for share in shares)
            ratio = stage["width_ratio"]
            cells += f"{'-' if ratio is None else f'{ratio:.2f}':>8}"
        lines.append(f"{row['scope']:<10}{str(schedule) if row['labels'] else 'none':<18}{cells}")
    alpha = 1.0 - report["confidence"]
    lines += [
        f"{row['scope']}: {row['labels']} labels, of which {row['labelled_missed']:.3f} missed; "
        f"|missed - {alpha:.1f}| <= (13.8 + (1 + d) eta)/(eta T) = {row['bound']:.2f}, for "
        "labelled frames only"
        for row in rows
        if "bound" in row
    ]
    return lines
