"""A complete run: estimate every frame of a source, write the estimates, and summarise."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import dataclass, field
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from cvo_edge.camera_check import LensEstimate
from cvo_edge.estimate import Drift, PoseInterval
from cvo_edge.ground_truth import GroundTruth
from cvo_edge.ground_truth.found import Key
from cvo_edge.input.followed import FollowedFolder
from cvo_edge.input.frame import Source
from cvo_edge.input.image_files import ImageFiles, left_out_text
from cvo_edge.monitor.adaptation import Adapted
from cvo_edge.odometer import Odometer
from cvo_edge.programs.labels import Labels
from cvo_edge.programs.measure import LatencyProfile, memory_mib
from cvo_edge.record import Status

Array = NDArray[np.float64]

# Logarithm of a focal length that differs so much from the stated one that a reader should know.
_WORTH_A_LOOK = 0.02


@dataclass
class RunSummary:
    """Counts, latencies and, with ground truth, coverage, in constant memory.

    ``truth`` gives the true poses; ``width_sum`` sums the widths of bounded frames, without gaps;
    ``disjoint`` counts frames with a gap in some degree of freedom; ``dropped`` counts frames
    dropped for a newer one; ``matched`` counts frames that have a true pose, ``compared`` those of
    status ok among them, and ``covered`` those whose set holds the true value, per degree of
    freedom; ``camera`` is what the frames show of the camera, if they do; ``left_out`` counts the
    images of a folder that are no frames, ``unproven`` the frames whose equal parts prove no
    repetition; ``labels`` are those that the thresholds have adapted to, ``adapted`` is what they
    came to; ``in_alarm`` counts frames during an alarm, and ``drift`` is the last frame's.
    """

    dof: tuple[str, ...]
    confidence: float
    scope: str
    truth: GroundTruth | None = None
    statuses: Counter[str] = field(default_factory=Counter)
    reasons: Counter[str] = field(default_factory=Counter)
    latency: LatencyProfile = field(default_factory=LatencyProfile)
    bounded: int = 0
    disjoint: int = 0
    dropped: int = 0
    width_sum: Array = field(default_factory=lambda: np.zeros(6))
    matched: int = 0
    compared: int = 0
    covered: Array = field(default_factory=lambda: np.zeros(6))
    covered_jointly: int = 0
    camera: LensEstimate | None = None
    in_alarm: int = 0
    drift: Drift | None = None
    left_out: Mapping[str, int] = field(default_factory=dict)
    labels: Labels | None = None
    adapted: Adapted | None = None
    unproven: int = 0
    # Frames are numbered from 0, so that dropped frames at the start are counted, too.
    _last_seq: int = -1
    _first_key: Key | None = None
    _last_key: Key | None = None

    def add(self, estimate: PoseInterval) -> None:
        """Count one estimate."""
        self.dropped += estimate.seq - self._last_seq - 1
        self._last_seq = estimate.seq
        self.statuses[estimate.status] += 1
        self.reasons.update(estimate.reasons)
        self.latency.add(estimate.latency_ms)
        self.drift = estimate.drift
        self.in_alarm += estimate.drift.state == "alarm"
        if estimate.bounded:
            self.bounded += 1
            self.width_sum += estimate.conformal_set.width()
            self.disjoint += any(len(row) > 1 for row in estimate.bands or ())
        if self.truth is not None:
            self._compare(estimate, self.truth)

    def _compare(self, estimate: PoseInterval, truth: GroundTruth) -> None:
        key = truth.key_of(estimate)
        self._first_key = key if self._first_key is None else self._first_key
        self._last_key = key if key is not None else self._last_key
        pose = truth.pose_of(estimate)
        self.matched += pose is not None
        # A frame that a check flags has no interval that could hold anything.
        if pose is not None and estimate.status is Status.OK:
            self.compared += 1
            self.covered += estimate.covers(pose)
            self.covered_jointly += estimate.contains(pose)

    def match_text(self, truth: GroundTruth) -> str:
        """Return how many frames have a true pose, and what frames and poses were matched by."""
        spans = truth.spans(self._first_key, self._last_key)
        return f"{self.matched} of {self.frames} frames matched by {truth.found.by} ({spans})"

    def _drift_text(self, drift: Drift) -> str:
        if drift.state == "unknown":
            return "unknown: this bundle has no alarm"
        if not self.in_alarm:
            return "clear: no alarm"
        now = "clear at the end"
        if drift.state == "alarm":
            now = f"{drift.reason} since frame {drift.since}"
        return f"alarm during {self.in_alarm} frames, {now}"

    @property
    def frames(self) -> int:
        """Number of frames seen."""
        return self.statuses.total()

    def lines(self) -> list[str]:
        """Return the summary as lines of readable text."""
        counts = ", ".join(f"{self.statuses[status]} {status}" for status in Status)
        lines = [f"frames      {self.frames}: {counts}; {self.bounded} with finite bounds"]
        if self.left_out:
            lines.append(f"left out    {left_out_text(self.left_out)}")
        if self.dropped:
            lines.append(f"dropped     {self.dropped} frames, for newer ones")
        if self.disjoint:
            lines.append(f"bands       {self.disjoint} frames with a set in more than one piece")
        if self.reasons:
            found = ", ".join(f"{name} {count}" for name, count in sorted(self.reasons.items()))
            lines.append(f"remarks     {found}")
        if self.unproven:
            lines.append(
                f"not checked {self.unproven} frames, for parts equal to earlier ones: their codec "
                "repeats what stands still"
            )
        if self.drift is not None:
            lines.append(f"drift       {self._drift_text(self.drift)}")
        if self.camera is not None:
            fx, fy, k1, frames = self.camera
            wrong = max(abs(math.log(fx)), abs(math.log(fy))) > _WORTH_A_LOOK
            lines.append(
                f"camera      by {frames} frames: fx {fx:.3f} x and fy {fy:.3f} x the stated, "
                f"k1 {k1:+.3f}" + ("; check the stated intrinsics" if wrong else "")
            )
        if self.labels is not None:
            lines.append(self.labels.line())
        if self.adapted is not None:
            lines.append(_adapted_line(self.adapted))
        if self.truth is not None:
            lines += _truth_lines(self, self.truth)
        latency = self.latency.summary()
        if latency:
            total, model = latency["total"], latency["model"]
            lines.append(
                f"latency ms  total p50 {total['p50']:.2f}  p95 {total['p95']:.2f}  "
                f"p99 {total['p99']:.2f}; model p50 {model['p50']:.2f}"
            )
        lines.append(f"memory MiB  peak {memory_mib()['peak_rss']:.0f}")
        width = self.width_sum / max(1, self.bounded)
        if self.bounded or self.compared:
            head = f"at {self.confidence:g} {self.scope}"
            lines.append(head + "".join(f"{name:>9}" for name in self.dof))
        if self.bounded:
            shown = [*map(_length, width[:3].tolist()), *map(_turn, width[3:].tolist())]
            cells = "".join(f"{cell:>9}" for cell in shown)
            lines.append("mean width".ljust(len(lines[-1]) - 54) + cells)
        if self.matched and not self.compared:
            lines.append(
                f"coverage    none of the {self.matched} frames with a true pose has status ok"
            )
        if self.compared:
            share = self.covered / self.compared
            lines.append(
                "coverage".ljust(len(lines[-1]) - 54) + "".join(f"{value:>9.3f}" for value in share)
            )
            six = self.covered_jointly / self.compared
            lines.append(f"all six     {six:.3f} of {self.compared} frames")
        return lines


def _length(width_m: float) -> str:
    """Return a width in at most eight characters, with the unit that suits it."""
    if width_m < 9.995:
        return _short(100.0 * width_m, "cm")
    return _short(width_m, "m") if width_m < 999.5 else _short(1e-3 * width_m, "km")


def _turn(width_rad: float) -> str:
    return _short(math.degrees(width_rad), "deg")


def _short(value: float, unit: str) -> str:
    # Three digits before the point leave no room for one after it.
    return f"{value:.1f} {unit}" if value < 99.95 else f"{value:.0f} {unit}"


def _truth_lines(summary: RunSummary, truth: GroundTruth) -> list[str]:
    said = [truth.found.note, str(truth.skipped) if truth.skipped else ""]
    if 2 * summary.matched < summary.frames:
        said.append(summary.match_text(truth))
    return [f"true poses  {text}" for text in said if text]


def _adapted_line(adapted: Adapted) -> str:
    if not adapted.labels:
        return "thresholds  as calibrated: no label yet" + ", frozen" * adapted.frozen
    frozen = " and frozen" * adapted.frozen
    factors = " ".join(f"{each:.3g}" for each in adapted.factor)
    return f"thresholds  adapted to {adapted.labels} labels{frozen}: {factors} x the calibrated"


def run(
    odometer: Odometer,
    frames: Source,
    write: Callable[[PoseInterval], None],
    *,
    summary: RunSummary,
    labels: Labels | None = None,
    max_frames: int | None = None,
    expect_motion: bool = False,
    tick: Callable[[PoseInterval], None] | None = None,
) -> None:
    """Estimate all ``frames``; write each estimate and count it in ``summary``.

    The caller owns the summary and can show it even if the source ends early. With
    ``expect_motion``, a picture that stands still is a doubt. ``tick`` gets each frame at last.
    The odometer gets the labels whose time has come after each estimate.
    """
    if isinstance(frames, ImageFiles | FollowedFolder):
        summary.left_out = frames.left_out
    summary.labels = labels
    try:
        with closing(odometer.stream(frames, moving=expect_motion or None)) as estimates:
            for estimate in islice(estimates, max_frames):
                write(estimate)
                summary.add(estimate)
                if labels is not None:
                    labels.after(estimate)
                if tick is not None:
                    tick(estimate)
    finally:
        summary.camera = odometer.seen_camera
        summary.unproven = odometer.unproven_frames
        summary.adapted = odometer.adapted
