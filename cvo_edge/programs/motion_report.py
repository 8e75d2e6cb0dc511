"""The texts of the commands on trajectories."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from cvo_edge.errors import printable
from cvo_edge.motion.audit import Audit, HorizonAudit, NeesAudit
from cvo_edge.motion.corrections import Fit
from cvo_edge.motion.format import MotionFile
from cvo_edge.motion.intervals import Level, MotionCalibration
from cvo_edge.programs.trajectories import MOST_SPREAD
from cvo_edge.vocabulary import MOTION_CORRECTIONS, MOTION_RULES, MotionCorrection

_AXES = "xyz"
# What is left over of rotations and translations of files that do not belong together, of cars or
# with quaternions in another order; of estimators seen so far, at most 0.12 and 0.07.
_DOUBT = (0.3, 0.1)
# More pairs than this are reported by their spread, and with so many that stand out.
_MOST_LINES, _MOST_ODD = 30, 10
# Time offsets that differ by more have no middle worth telling.
_ALIKE_S = 0.02


def fit_lines(fits: Sequence[Fit], made: Sequence[str]) -> Iterator[str]:
    """Yield the alignment report: one line a pair, then what is worth correcting.

    Of many pairs: their spread, and those that stand out.
    """
    if not fits:
        yield "alignment: not compared, as the drives are too short"
    elif len(fits) <= _MOST_LINES:
        yield from _pair_lines(fits)
    else:
        yield from _spread_lines(fits)
        if odd := sorted((each for each in fits if _stands_out(each)), key=_gain):
            yield f"{len(odd)} of {len(fits)} stand out; most of all:"
            yield from _pair_lines(odd[:_MOST_ODD])
    doubted = [fit for fit in fits if _doubtful(fit)]
    for fit in doubted[:_MOST_ODD]:
        rotation, translation = fit.alignment.misfit.tolist()
        yield (
            f"doubt: {printable(fit.name)}: {rotation:.0%} of rotations and {translation:.0%} "
            "of translations do not fit the truth; check the pair, stamps and the quaternions' "
            "order (qx qy qz qw)"
        )
    if len(doubted) > _MOST_ODD:
        yield f"doubt: {len(doubted) - _MOST_ODD} more like these"
    for correction in MOTION_CORRECTIONS:
        yield from _worth(fits, correction, correction in made)


def _pair_lines(fits: Sequence[Fit]) -> Iterator[str]:
    width = max(len("recording"), *(len(printable(fit.name)) for fit in fits))
    yield (
        f"{'recording':<{width}}  {'truth - estimate':>16}  {'body frame, deg (x y z)':>26}  "
        f"{'scale':>14}  undetermined"
    )
    for fit in fits:
        found = fit.alignment
        turn = " ".join(f"{value:.2f}" for value in np.rad2deg(found.determined_rotation))
        lost = ", ".join("about " + _axis(axis) for axis in found.undetermined) or "-"
        yield (
            f"{printable(fit.name):<{width}}  "
            f"{1e3 * found.offset_s:7.1f} +-{1e3 * found.offset_error_s:4.1f} ms  "
            f"{turn:>26}  {found.scale:.4f}+-{found.scale_error:.4f}  {lost}"
        )


def _spread_lines(fits: Sequence[Fit]) -> Iterator[str]:
    """Yield least, median and largest value of what was found, with the names of both ends."""
    found = [each.alignment for each in fits]
    rows = {
        "truth - estimate, ms": [1e3 * each.offset_s for each in found],
        "body frames differ by, deg": [
            math.degrees(float(np.linalg.norm(each.determined_rotation))) for each in found
        ],
        "scale": [each.scale for each in found],
        "left over of rotations, %": [100.0 * float(each.misfit[0]) for each in found],
        "left over of translations, %": [100.0 * float(each.misfit[1]) for each in found],
    }
    yield f"{f'{len(fits)} recordings':<30}{'least':>9}{'median':>9}{'largest':>9}"
    for name, values in rows.items():
        ends = (printable(fits[int(place(values))].name) for place in (np.argmin, np.argmax))
        numbers = "".join(f"{of(values):>9.4g}" for of in (min, np.median, max))
        yield f"{name:<30}{numbers}  {' .. '.join(ends)}"
    if lost := sum(len(each.undetermined) > 0 for each in found):
        yield f"an axis is undetermined in {lost} of {len(fits)}"


def _doubtful(fit: Fit) -> bool:
    return bool((fit.alignment.misfit > _DOUBT).all())


def _stands_out(fit: Fit) -> bool:
    return _doubtful(fit) or any(effect.worth for effect in fit.effects.values())


def _gain(fit: Fit) -> float:
    """Return the least share of an error that corrections would leave."""
    shares = [
        np.nanmin(each.after / np.maximum(each.before, 1e-12), initial=1.0)
        for each in fit.effects.values()
        if each.worth
    ]
    return float(min(shares, default=1.0))


def _axis(axis: np.ndarray) -> str:
    """Return an axis by its name if it is nearly one of the body's, else its numbers."""
    largest = int(np.argmax(np.abs(axis)))
    if abs(axis[largest]) > math.cos(math.radians(15.0)):
        return _AXES[largest]
    return "(" + " ".join(f"{value:.2f}" for value in axis) + ")"


def _worth(fits: Sequence[Fit], correction: MotionCorrection, made: bool) -> Iterator[str]:
    found = [fit for fit in fits if correction in fit.effects and fit.effects[correction].worth]
    if not found:
        return
    before = np.median([fit.effects[correction].before for fit in found], axis=0)
    after = np.median([fit.effects[correction].after for fit in found], axis=0)
    changes = "; ".join(
        f"over {name} {100 * b[0]:.3g} -> {100 * a[0]:.3g} cm, "
        f"{math.degrees(b[1]):.3g} -> {math.degrees(a[1]):.3g} deg"
        for name, b, a in zip(("one frame", "1 s"), before, after, strict=True)
    )
    what = _what(found, correction)
    yield (
        f"{correction}: {what} in {len(found)} of {len(fits)}: correcting it takes the error that "
        f"90 % of motions do not exceed (median) {changes}"
    )
    scales = [fit.alignment.scale for fit in fits]
    if correction == "scale" and max(scales) > MOST_SPREAD * min(scales):
        yield (
            "  not corrected: scales differ too much from each other for one number; an estimator "
            "of one camera has none: give it steps of length 1, after # scale: none"
        )
    elif made:
        yield "  corrected, as asked"
    else:
        yield f"  not corrected; --correct {correction} does that"


def _what(found: Sequence[Fit], correction: MotionCorrection) -> str:
    if correction == "time":
        offsets = [fit.alignment.offset_s for fit in found]
        period_s = float(np.median([fit.period_s for fit in found]))
        least, middle, most = min(offsets), float(np.median(offsets)), max(offsets)
        frames = max(abs(least), abs(most)) / period_s
        if most - least > _ALIKE_S:
            return f"stamps differ by {least:.3f} .. {most:.3f} s (up to {frames:.1f} frames)"
        return f"stamps differ by {middle:.3f} s ({abs(middle) / period_s:.1f} frames)"
    if correction == "frame":
        turns = [np.linalg.norm(fit.alignment.determined_rotation) for fit in found]
        return f"body frames differ by {math.degrees(float(np.median(turns))):.2f} deg"
    scales = [fit.alignment.scale for fit in found]
    return f"the scale differs ({min(scales):.3f} .. {max(scales):.3f})"


def calibration_lines(file: MotionFile) -> Iterator[str]:
    """Yield what was calibrated: for each horizon half-widths at 0.9, and what each rule states."""
    calibration = MotionCalibration(file)
    first = "direction in deg" if calibration.pointed else "cm"
    yield (
        f"{'horizon':>8}{'drives':>8}{'motions':>9}{'bias':>6}{'scale':>7}  "
        f"usual radius at 0.9: {first}, rotation in deg by rule"
    )
    for spec, horizon in zip(file.horizons, calibration.horizons, strict=True):
        parts = []
        for rule in MOTION_RULES:
            radii = horizon.thresholds(Level(rule=rule))[6:] * spec.usual[6:]
            if calibration.pointed:
                # Printed in cm.
                radii[0] = 0.01 * math.degrees(radii[0])
            parts.append(f"{rule} {_radii(*radii)}")
        yield (
            f"{spec.horizon:>8}{spec.recordings:>8}{spec.motions:>9}"
            f"{'yes' if spec.bias else 'no':>6}{'yes' if spec.scale else 'no':>7}  "
            + "; ".join(parts)
        )
    for window in calibration.windows:
        ends = [window.end_radii(Level(rule=rule)) for rule in MOTION_RULES]
        parts = [f"{rule} {_radii(*end)}" for rule, end in zip(MOTION_RULES, ends, strict=True)]
        yield (
            f"tube of {window.spec.window}: {window.spec.recordings} drives, "
            f"{window.spec.anchors} anchors; usual radius at its end: " + "; ".join(parts)
        )
    for rule in MOTION_RULES:
        yield f"{rule}: {calibration.statement(Level(rule=rule))}"


def _radii(position: float, rotation: float) -> str:
    """Return radii in cm and degrees."""
    if not math.isfinite(position):
        return "unbounded"
    return f"{100.0 * position:.3g} {math.degrees(rotation):.2g}"


def audit_lines(report: Audit) -> Iterator[str]:
    """Yield an audit: coverage and width by horizon, over recordings."""
    yield f"{report.calibration}: {report.confidence:g} {report.rule}, {report.scope}"
    yield report.statement
    if report.calibrated_on:
        names = ", ".join(map(printable, report.calibrated_on))
        yield f"warning: as long as recordings of the calibration, which test nothing: {names}"
    withheld = {each.name: each.withheld for each in report.recordings if each.withheld >= 0.005}
    if withheld:
        names = ", ".join(f"{printable(name)} {share:.2f}" for name, share in withheld.items())
        yield f"share of poses without intervals, as faster or rougher than calibrated: {names}"
    rate = {each.name: each.other_rate for each in report.recordings if each.other_rate >= 0.005}
    if rate:
        names = ", ".join(f"{printable(name)} {share:.2f}" for name, share in rate.items())
        yield f"share of poses at another rate, without horizons in frames and integrated: {names}"
    if any(each.directions is not None for one in report.recordings for each in one.horizons):
        yield from _pointed_lines(report)
        return
    yield (
        f"{'horizon':>8}{'recordings':>12}{'each DoF':>10}{'all six':>9}{'position':>10}"
        f"{'rotation':>10}{'least':>7}  mean half-width, radius"
    )
    for name in report.horizons:
        found = report.over(name)
        if not found:
            yield f"{name:>8}{0:>12}  no motion with a truth at both ends"
            continue
        dof = np.array([each.dof for each in found])
        half = np.mean([each.half_widths for each in found], axis=0)
        radii = np.mean([each.radii for each in found], axis=0)
        yield (
            f"{name:>8}{len(found):>12}{dof.mean():>10.3f}"
            f"{np.mean([each.joint for each in found]):>9.3f}"
            f"{np.mean([each.position for each in found]):>10.3f}"
            f"{np.mean([each.rotation for each in found]):>10.3f}"
            f"{dof.mean(axis=1).min():>7.2f}  "
            f"{100 * half[:3].mean():.3g} cm {math.degrees(half[3:].mean()):.3g} deg, "
            f"{100 * radii[0]:.3g} cm {math.degrees(radii[1]):.3g} deg"
        )
    for name in dict.fromkeys(each.window for r in report.recordings for each in r.windows):
        windows = [
            each
            for recording in report.recordings
            for each in recording.windows
            if each.window == name and each.windows
        ]
        if windows:
            yield (
                f"tube of {name}: whole windows inside, over {len(windows)} recordings: position "
                f"{np.mean([each.position for each in windows]):.3f}, rotation "
                f"{np.mean([each.rotation for each in windows]):.3f}, all six "
                f"{np.mean([each.six for each in windows]):.3f}"
            )
    yield "NEES over 6 (1 fits), and share up to chi-square's 0.9 quantile; means over recordings"
    for name in report.horizons:
        found = report.over(name)
        if found:
            yield _nees_line(f"{name:>8}  interval  ", found)
    for span_s in dict.fromkeys(each.seconds for r in report.recordings for each in r.integrated):
        sums = [x for r in report.recordings for x in r.integrated if x.seconds == span_s]
        yield _nees_line(f"{span_s:>7g}s  integrated", sums)


def _pointed_lines(report: Audit) -> Iterator[str]:
    """Yield coverage and width of an estimator without a scale."""
    yield (
        f"{'horizon':>8}{'recordings':>12}{'each DoF':>10}{'all three':>11}{'rotation':>10}"
        f"{'direction':>11}{'with one':>10}  mean half-width, radius, direction: deg"
    )
    for name in report.horizons:
        found = report.over(name)
        if not found:
            yield f"{name:>8}{0:>12}  no motion with a truth at both ends"
            continue
        some = [each for each in found if each.directions]
        inside = f"{np.mean([each.position for each in some]):.3f}" if some else "-"
        radius = f"{math.degrees(np.mean([each.radii[0] for each in some])):.3g}" if some else "-"
        share = sum(each.directions or 0 for each in found) / sum(each.motions for each in found)
        yield (
            f"{name:>8}{len(found):>12}{np.mean([each.dof for each in found]):>10.3f}"
            f"{np.mean([each.joint for each in found]):>11.3f}"
            f"{np.mean([each.rotation for each in found]):>10.3f}{inside:>11}{share:>10.2f}  "
            f"{math.degrees(np.mean([each.half_widths for each in found])):.3g}, "
            f"{math.degrees(np.mean([each.radii[1] for each in found])):.3g}, {radius}"
        )


def _nees_line(what: str, found: Sequence[HorizonAudit] | Sequence[NeesAudit]) -> str:
    ratio = np.mean([each.nees for each in found])
    return f"{what}  {ratio:6.2f}{np.mean([each.nees_inside for each in found]):8.3f}"
