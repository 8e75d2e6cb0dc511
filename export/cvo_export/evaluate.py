"""Coverage, width and error of a bundle on held-out frames, measured through the runtime."""

from __future__ import annotations

import os
from collections.abc import Collection, Mapping
from dataclasses import asdict
from typing import Any, get_args

import msgspec
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from cvo_edge.bundle.format import Calibration, LeftOut, StillDof
from cvo_edge.engine.loading import read_bundle
from cvo_edge.errors import GateError, UsageError
from cvo_edge.given import given_path
from cvo_edge.guarantee import by_level, left_out_text
from cvo_edge.heads import HEADS
from cvo_edge.odometer import Odometer
from cvo_export.bundles.draft import still_text
from cvo_export.bundles.figures import Claim, Sets, point_error
from cvo_export.bundles.observed import observe
from cvo_export.bundles.online import Schedule, Stage, online, online_lines
from cvo_export.bundles.rule import chosen_rule
from cvo_export.bundles.thresholds import with_thresholds
from cvo_export.data.noise import Noise, noisy
from cvo_export.data.pose_errors import MedianError, mean_pose_error
from cvo_export.data.splits import Split, same_split
from cvo_export.datasets import PoseDataset
from cvo_export.vocabulary import Subset

Array = NDArray[np.float64]


# Footnotes for coverage bands that are not exact.
_INDICATIVE = (
    "? indicative: frames of one recording are not independent draws; the band is that of as many "
    "independent frames as they are worth, a dash says that these are too few"
)
_NO_CLAIM = "- no band: thresholds from clean frames guarantee nothing for noisy frames"
# Error as a share of the mean pose's from which a network has learned next to nothing.
_HARDLY_BETTER = 0.9
_CROSSED = (
    "recalibrated: not for a crossed calibration, whose network was trained on its calibration "
    "frames"
)


def evaluate(
    bundle_dir: str | os.PathLike[str],
    dataset: PoseDataset,
    subset: Subset,
    threads: int | None = None,
    noise: Noise | None = None,
    schedule: Schedule | None = None,
    then: Noise | None = None,
) -> dict[str, Any]:
    """Evaluate every stored confidence and scope; the report of ``cvo-export evaluate --json``.

    The subset ``test`` is the test role of the bundle's recorded split; ``all`` is every frame of
    a data set that the run has not seen. Frames that a check flags are left out and counted.

    ``noise`` degrades every frame, with the split's seed. The report then contains two sets of
    figures: with the bundle's thresholds, which come from clean frames, and with thresholds from
    the run's cal frames under the same noise (``recalibrated``). Without noise, a run that was
    split by sequence is also evaluated with another calibration rule (``other_rule``): ``pooled``,
    or ``capped`` if that is the bundle's. A bundle with a crossed calibration has neither, because
    its network was trained on the cal frames.

    With a ``schedule`` of labels, the frames are also played in order, clean, with the noise
    ``then``, and clean again, and the thresholds adapt to the labels (``online``).

    Raises
    ------
    SourceError
        The data set is not the one that was split, or no frame passes the checks.
    UsageError
        Noise with the subset ``all``; a schedule with ``noise``; ``then`` without a schedule.
    """
    bundle_dir = given_path(bundle_dir, "bundle")
    if (schedule is None and then is not None) or (schedule is not None and noise is not None):
        raise UsageError(
            "then: expected --online every=K,delay=D with --then NOISE and without --noise"
        )
    bundle = read_bundle(bundle_dir)
    calibration = bundle.calibration
    dataset = dataset.decoded(calibration.preprocess.decode)
    recorded = calibration.calibration.split
    first = calibration.thresholds[0]
    split = same_split(dataset, recorded) if subset == "test" else None
    if noise is not None:
        if split is None:
            raise UsageError(
                "noise: expected --subset test, whose split has calibration frames to recalibrate "
                f"on, found {subset}"
            )
        dataset = noisy(dataset, noise, recorded.seed)
    later = None if then is None else noisy(dataset, then, recorded.seed)
    indices = subset_indices(calibration, dataset, subset)
    claim: Claim = "exact" if split is not None and split.kind == "random" else "indicative"
    with Odometer(
        bundle,
        threads=threads,
        confidence=first.confidence,
        scope=first.scope,
        camera=dataset.camera() if bundle.head.solves else None,
    ) as odometer:
        seen = observe(odometer, dataset, indices)
        # Clean and noisy frames are not exchangeable, so no coverage can be claimed.
        sets = Sets(odometer, seen, calibration, claim if noise is None else "none")
        levels = sets.levels()
        report = {
            "bundle": calibration.name,
            "method": calibration.method,
            "dataset": dataset.name,
            "subset": subset,
            "split": recorded.kind,
            "noise": None if noise is None else {**asdict(noise), "seed": recorded.seed},
            "rule": calibration.calibration.rule,
            "score": calibration.calibration.score,
            "frames": {
                "total": len(indices),
                "bounded": _bounded(levels, len(seen.indices)),
                "degraded": seen.refused.degraded,
                "invalid": seen.refused.invalid,
            },
            "n_calibration": calibration.calibration.n,
            # If true, the subset "all" may include frames that the network was trained on.
            "named_as_training_data": dataset.name == calibration.provenance.dataset,
            "still": list(calibration.pose.still),
            "point_error": point_error(seen),
            "mean_pose_error": mean_pose_error(seen.true_pose)._asdict(),
            "own": sets.own(),
            "levels": levels,
            "sequences": sets.sequences(dataset),
        }
        if schedule is not None:
            stages = [Stage("clean", indices, seen)]
            if later is not None:
                changed = Stage(str(then), indices, observe(odometer, later, indices))
                stages = [*stages, changed, *stages]
            report["online"] = online(odometer, calibration, dataset.poses, stages, schedule)
        if split is None or calibration.calibration.crossed is not None:
            return report
        if noise is not None:
            again = _recalibrated(odometer, dataset, split, calibration)
            others = Sets(odometer, seen, again, claim)
            report["recalibrated"] = {
                "n_calibration": again.calibration.n,
                "left_out": split.roles["cal"].size - again.calibration.n,
                "levels": others.levels(),
                "sequences": others.sequences(dataset),
            }
        elif split.kind == "sequence":
            other = _recalibrated(odometer, dataset, split, _by_the_other_rule(calibration))
            others = Sets(odometer, seen, other, claim)
            report["other_rule"] = {"rule": other.calibration.rule, "levels": others.levels()}
    return report


def subset_indices(
    calibration: Calibration, dataset: PoseDataset, subset: Subset
) -> NDArray[np.int64]:
    """Return the frame numbers of the recorded test role, or of all frames.

    Raises SourceError if the data set is not the one that was split.
    """
    if subset == "all":
        return np.arange(len(dataset))
    return same_split(dataset, calibration.calibration.split).roles["test"]


def check_coverage(report: Mapping[str, Any], least: float) -> None:
    """Raise GateError if the marginal coverage of any DoF at 0.9 is below ``least``.

    The check always uses the bundle's own thresholds, also under noise.
    """
    level = find_level(report["levels"], 0.9, "marginal")
    worst = min(level["coverage"])
    if not worst >= least:
        raise GateError(f"evaluate: expected coverage of at least {least:g}, found {worst:.4f}")


def find_level(levels: list[dict[str, Any]], confidence: float, scope: str) -> dict[str, Any]:
    """Return the entry for a confidence and a scope; every bundle stores the same confidences."""
    return next(
        level for level in levels if level["confidence"] == confidence and level["scope"] == scope
    )


def table(report: Mapping[str, Any]) -> list[str]:
    """Return the report as lines of readable text."""
    error, frames = report["point_error"], report["frames"]
    lines = [
        f"{report['bundle']} ({report['method']}, {report['score']} score) on {report['dataset']}, "
        f"{report['subset']} frames of a {report['split']} split",
        f"frames {frames['total']}, invalid {frames['invalid']}, degraded {frames['degraded']}; "
        f"calibrated on "
        f"{report['n_calibration']}",
        f"point error  median {100 * error['median_m']:.2f} cm {error['median_deg']:.2f} deg, "
        f"90 % {100 * error['p90_m']:.2f} cm {error['p90_deg']:.2f} deg, "
        f"99 % {100 * error['p99_m']:.2f} cm {error['p99_deg']:.2f} deg",
        *_mean_pose_lines(error, MedianError(**report["mean_pose_error"]), report["still"]),
    ]
    if report["still"]:
        lines.append(still_text(report["still"]))
    if report["noise"] is not None:
        noise = Noise(report["noise"]["name"], report["noise"]["strength"])
        lines.append(f"noise {noise} ({noise.unit}), seed {report['noise']['seed']}")
    if report["subset"] == "all" and report["named_as_training_data"]:
        lines.append(
            "warning: this data set has the name of the training data; the figures hold only if "
            "none of its frames was used for training"
        )
    if report["own"] is not None:
        own = report["own"]
        coverage = " ".join(f"{value:.3f}" for value in own["coverage"])
        lines.append(
            f"the network's own bounds at 0.9, uncalibrated: coverage {coverage}, all six "
            f"{own['joint_coverage']:.3f}, score {own['normalised_interval_score']:.3f}"
        )
    if report["noise"] is None:
        lines += ["", *_level_lines(report, report["rule"], report["levels"])]
        if "other_rule" in report:
            other = report["other_rule"]
            lines += ["", *_level_lines(report, other["rule"], other["levels"])]
        lines += _sequence_lines(report["sequences"])
        return [*lines, "", *online_lines(report["online"])] if "online" in report else lines
    lines += [
        "",
        f"clean: the bundle's own thresholds, from {report['n_calibration']} frames without noise",
        *_level_lines(report, report["rule"], report["levels"], _NO_CLAIM),
        *_sequence_lines(report["sequences"]),
        "",
    ]
    if "recalibrated" not in report:
        return [*lines, _CROSSED]
    again = report["recalibrated"]
    return [
        *lines,
        f"recalibrated: thresholds from {again['n_calibration']} calibration frames with the same "
        f"noise; {again['left_out']} left out",
        *_level_lines(report, report["rule"], again["levels"]),
        *_sequence_lines(again["sequences"]),
    ]


def _mean_pose_lines(
    error: Mapping[str, float], mean: MedianError, still: Collection[str]
) -> list[str]:
    """Return the error of one pose for all frames; say if the network is hardly better."""
    shares = MedianError(error["median_m"], error["median_deg"]).shares(mean)
    names = get_args(StillDof)
    parts = zip(("position", "rotation"), shares, (names[:3], names[3:]), strict=True)
    kinds = [
        kind for kind, share, dof in parts if share > _HARDLY_BETTER and not set(dof) <= set(still)
    ]
    lines = [
        f"mean pose    median {100 * mean.position_m:.2f} cm {mean.rotation_deg:.2f} deg: one pose "
        "for all these frames"
    ]
    if kinds:
        lines.append(
            f"warning: in {' and '.join(kinds)} the network is hardly better than that; it has not "
            "learned the place from so few or such different frames"
        )
    return lines


def _bounded(levels: list[dict[str, Any]], frames: int) -> int:
    """Return the number of frames with finite bounds at the lowest stored confidence."""
    lowest = min(levels, key=lambda level: level["confidence"])
    return round((1.0 - float(lowest["unbounded_share"])) * frames)


def _level_lines(
    report: Mapping[str, Any],
    rule: str,
    levels: list[dict[str, Any]],
    footnote: str = _INDICATIVE,
) -> list[str]:
    names = get_args(StillDof)
    kinds = [
        [dof for dof in kind if names[dof] not in report["still"]] or kind
        for kind in ([0, 1, 2], [3, 4, 5])
    ]
    lines = [
        f"{rule + ' rule':<20}{'coverage: tx ty tz, three rotations':^42}{'joint':>7}"
        f"{'99 % band':>16}{'width cm':>10}{'deg':>7}{'score':>8}",
    ]
    for level in levels:
        coverage = "".join(f"{value:>7.3f}" for value in level["coverage"])
        kind = "coverage_band" if level["coverage_band_exact"] else "coverage_band_effective"
        band = level[kind]
        shown = "-" if band is None else f"{band[0]:.3f}-{band[1]:.3f}"
        shown += " " if level["coverage_band_exact"] or band is None else "?"
        width = np.array(level["median_width"])
        lines.append(
            f"{level['confidence']:<8g}{level['scope']:<12}{coverage}"
            f"{level['joint_coverage']:>7.3f}{shown:>16}{_cell(100 * width[kinds[0]].mean(), 10)}"
            f"{_cell(np.rad2deg(width[kinds[1]].mean()), 7)}"
            f"{_cell(level['normalised_interval_score'], 8, 3)}"
        )
    for level in levels:
        if level["confidence"] == 0.9 and "disjoint_share" in level:
            own = HEADS[report["method"]].figures_text(level)
            lines.append(
                f"{level['confidence']:<8g}{level['scope']:<12}{own + ', ' if own else ''}"
                f"disjoint {100 * np.mean(level['disjoint_share']):.1f} % of sets, "
                f"{100 * level['disjoint_frames']:.0f} % of frames"
            )
    lines += [
        f"{level['confidence']:<8g}{level['scope']:<12}volume in units of the poses' standard "
        f"deviations, to the power 1/6: {level['joint_volume']['geometric_mean'] ** (1 / 6):.3f}"
        for level in levels
        if level["confidence"] == 0.9 and "joint_volume" in level
    ]
    lines += [
        f"{level['confidence']:<8g}{level['scope']:<12}covariance: NEES / 6 {nees['mean']:.2f} "
        f"(median {nees['median']:.2f}), {nees['inside']:.2f} within the ellipsoid of 0.9"
        for level in levels
        if level["confidence"] == 0.9 and (nees := level["nees"])
    ]
    if not all(level["coverage_band_exact"] for level in levels):
        lines.append(footnote)
    return lines + _proven_lines(levels)


def _cell(value: float, width: int, decimals: int = 2) -> str:
    """Return a number that never touches the column before, however large it is."""
    text = f"{value:.{decimals}f}"
    return f"{text if len(text) < width else f'{value:.1g}':>{width}}"


def _sequence_lines(sequences: Mapping[str, Any]) -> list[str]:
    if len(sequences) < 2:
        return []
    lines = ["", f"{'sequence':<14}{'frames':>8}{'coverage at 0.9 per DoF':>44}{'joint':>10}"]
    for name, entry in sequences.items():
        cells = "".join(f"{value:>8.2f}" for value in entry["coverage"])
        lines.append(f"{name:<14}{entry['frames']:>8}{cells:>48}{entry['joint_coverage']:>10.2f}")
    return lines


def _recalibrated(
    odometer: Odometer, dataset: PoseDataset, split: Split, draft: Calibration
) -> Calibration:
    """Return the draft with thresholds from the run's cal frames, read from this data set."""
    val, cal = (observe(odometer, dataset, split.roles[role]) for role in ("val", "cal"))
    return with_thresholds(draft, odometer.head, val, cal)


def _by_the_other_rule(calibration: Calibration) -> Calibration:
    source = calibration.calibration
    rule, cap = chosen_rule(None if source.rule == "pooled" else "pooled", None, "sequence")
    return replace(calibration, calibration=replace(source, rule=rule, cap=cap))


def _proven_lines(levels: list[dict[str, Any]]) -> list[str]:
    """Say what is proven at each level, and what was measured on the calibration recordings.

    Nothing for thresholds that make no claim about these frames.
    """
    stated = [
        (level["confidence"], level["scope"], level["statement"])
        for level in levels
        if level["statement"] is not None
    ]
    found = [
        left_out_text(level["scope"], msgspec.convert(level["left_out"], LeftOut))
        for level in levels
        if level["confidence"] == 0.9 and level["left_out"] is not None
    ]
    measured = [f"coverage of a calibration recording left out, at 0.9: {', '.join(found)}"]
    return [f"at {level}: {text}" for level, text in by_level(stated)] + (
        measured if stated and found else []
    )
