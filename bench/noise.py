"""The six noises of the study at thresholds for clean frames, with the alarm and without.

    python bench/noise.py BUNDLE DATASET [--seed 0] [--json FILE]
    python bench/noise.py RUN [DATASET] [--seed 0] [--json FILE]

Test frames of the bundle's own data, recording by recording. *Alarm ignored*: the sets of all
frames that pass the frame checks of the image itself, as if nothing else were ever doubted. *With
the alarm*: the finite intervals of a stream. The constant oracle knows the noisy frames' errors:
for each degree of freedom one half-width that covers 90 % of them. Figures are for 0.9; coverage
per degree of freedom and widths in the marginal scope, joint coverage in the joint one. ``--seed``
draws the noise.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from played import CONFIDENCE, Array, Subject, by_recording, remembered
from provenance import write_result

from cvo_edge.bundle.quantiles import threshold_at
from cvo_edge.estimate import PoseInterval
from cvo_edge.odometer import Odometer
from cvo_edge.record import Reason
from cvo_edge.sets import ConformalSet
from cvo_export.bundles.choice import workspace
from cvo_export.data.noise import KINDS, Noise, noisy
from cvo_export.datasets import PoseDataset

# Checks of the image itself, which calibration leaves out as well.
UNUSABLE = (Reason.IMAGE_BLACK, Reason.IMAGE_SATURATED, Reason.IMAGE_FLAT)

Figures = dict[str, Any]


class Frames:
    """What a bundle gives for frames: sets of both scopes, and the intervals of the stream."""

    def __init__(self, subject: Subject, dataset: PoseDataset) -> None:
        self.marginal: list[ConformalSet] = []
        self.joint: list[ConformalSet] = []
        self.point: list[Array] = []
        self.truth: list[Array] = []
        self.given: list[tuple[PoseInterval, Array]] = []
        self.pose = subject.bundle.calibration.pose
        for recording in by_recording(dataset, subject.roles["test"]):
            with Odometer(
                subject.bundle, threads=1, confidence=CONFIDENCE, scope="joint"
            ) as odometer:
                for row in recording.tolist():
                    self._add(odometer, dataset.read_image(row), dataset.poses[row])

    def _add(self, odometer: Odometer, image: Any, truth: Array) -> None:  # noqa: ANN401
        seen = odometer.observe(image, len(self.given))
        self.given.append((odometer.step(image), truth))
        if seen.fault is not None or seen.doubt in UNUSABLE:
            return
        for scope, sets in (("marginal", self.marginal), ("joint", self.joint)):
            threshold = threshold_at(odometer.calibration, CONFIDENCE, scope)
            sets.append(odometer.conformal_set(seen, threshold))
        self.point.append(seen.point)
        self.truth.append(odometer.chart.coordinates(truth, seen.pose))

    def ignored(self) -> Figures:
        """Return the figures of all usable frames, whatever an alarm says."""
        if not self.truth:
            return {"frames": 0}
        errors = np.abs(np.array(self.truth) - np.array(self.point))
        oracle = 2.0 * np.quantile(errors, CONFIDENCE, axis=0, method="higher")
        limits = workspace(self.pose)
        width = np.array([each.within(*limits).width() for each in self.marginal]).mean(axis=0)
        return {
            "frames": len(self.truth),
            "coverage": _mean(e.covers(y) for e, y in zip(self.marginal, self.truth, strict=True)),
            "joint_coverage": _mean(
                e.contains(y) for e, y in zip(self.joint, self.truth, strict=True)
            ),
            "mean_width": width.tolist(),
            "oracle_width": oracle.tolist(),
            "over_oracle": float(np.mean(width / oracle)),
            "unbounded": _mean(not np.isfinite(each.width()).all() for each in self.marginal),
        }

    def with_alarm(self) -> Figures:
        """Return the share of frames with an interval, and the joint coverage of these.

        A frame with an interval is missed if the truth is outside in any degree of freedom.
        """
        finite = [(estimate, truth) for estimate, truth in self.given if estimate.bounded]
        inside = [estimate.contains(truth) for estimate, truth in finite]
        return {
            "frames": len(self.given),
            "finite": len(finite) / len(self.given),
            "joint_coverage": float(np.mean(inside)) if inside else None,
        }


def _mean(values: Iterable[Any]) -> Any:  # noqa: ANN401 - a float, or one for each column
    return np.mean(list(values), axis=0).tolist()


def line(name: str, found: Figures) -> str:
    """Return one row of what is printed."""
    ignored, given = found["ignored"], found["with_alarm"]
    if not ignored["frames"]:
        return f"  {name:<16} no usable frame"
    coverage = given["joint_coverage"]
    joint = "-" if coverage is None else f"{coverage:.3f}"
    return (
        f"  {name:<16} coverage {np.mean(ignored['coverage']):.3f} (least "
        f"{np.min(ignored['coverage']):.3f}), joint {ignored['joint_coverage']:.3f}, width "
        f"{100 * np.mean(ignored['mean_width'][:3]):.1f} cm, {ignored['over_oracle']:.2f} x the "
        f"oracle's; with the alarm finite {given['finite']:.3f}, joint coverage {joint}"
    )


def main() -> None:
    """Print a row for clean frames and each noise; write them as JSON where asked."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("bundle", type=Path, help="bundle or run folder")
    parser.add_argument("dataset", nargs="?", help="data set; a run knows its own")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    subject = Subject.of(arguments.bundle, arguments.dataset)
    clean = remembered(subject.dataset)
    report: dict[str, Figures] = {}
    for name in ("none", *KINDS):
        dataset = clean
        if name != "none":
            dataset = noisy(clean, Noise(name, KINDS[name].default), arguments.seed)
        frames = Frames(subject, dataset)
        report[name] = {"ignored": frames.ignored(), "with_alarm": frames.with_alarm()}
        print(line(name, report[name]), flush=True)
    if arguments.json:
        heading = {"what": "noise", **subject.heading, "seed": arguments.seed}
        write_result(arguments.json, {**heading, "noises": report})


if __name__ == "__main__":
    main()
