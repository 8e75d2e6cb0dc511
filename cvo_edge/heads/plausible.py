"""Whether the numbers of a calibration can be those of an honest one.

Digests show that a bundle is complete. Its numbers also depend on each other: counts decide which
thresholds are finite, thresholds grow, and the sets of the self-test image have a width. Nothing
here needs the model, because ``calibration.json`` holds its outputs for the self-test image.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cvo_edge.bundle.format import (
    SELFTEST_TOLERANCE,
    Calibration,
    CalibrationSpec,
    Threshold,
)
from cvo_edge.bundle.quantiles import table_entries
from cvo_edge.conformal import conformal_rank, least_draws, recording_cap
from cvo_edge.documents import shown
from cvo_edge.errors import CalibrationFileError
from cvo_edge.heads import Head
from cvo_edge.input.view import crop_view, seen_camera
from cvo_edge.pose import Chart
from cvo_edge.sets import ConformalSet
from cvo_edge.vocabulary import SCOPES

Array = NDArray[np.float64]

# No network with float32 outputs is this precise: a share of the spread of the poses.
_LEAST_WIDTH = 1e-6
# Corrections may empty the set of a frame, but not of the frames that a high level has to cover.
_HIGH = 0.9
# These two levels are always stored, and differ by more frames than one.
_MIDDLE = 0.5
_FEW = 30
_ROUNDING = 1e-9
# The quaternion of every pose among the outputs, by the name of the output.
_QUATERNIONS = {"pose": slice(3, 7), "regression": slice(3, 7)}


class Draws(NamedTuple):
    """What a rule counts: its ``unit``, how many were ``given`` and how many a level ``needs``.

    ``cap`` is that of ``capped_quantile``, and 1 for frames.
    """

    unit: str
    given: int
    cap: float

    @classmethod
    def of(cls, source: CalibrationSpec) -> Draws:
        """Return what the rule of a calibration counts."""
        cap = recording_cap(source.rule, source.cap)
        if cap is None:
            return cls("frames", source.n, 1.0)
        return cls("recordings", source.n_sequences, cap)

    def needed(self, level: float) -> int:
        """Return the least number for which the threshold of a level is finite."""
        return least_draws(level, self.cap)


def check_plausible(calibration: Calibration, head: Head) -> None:
    """Raise CalibrationFileError, naming the key, if the numbers contradict each other."""
    entries = (*calibration.thresholds, *table_entries(calibration))
    _check_counts(calibration.calibration)
    # The stored ones were checked when the file was read.
    head.check(entries, calibration.calibration.joint)
    for entry in entries:
        _check_bounded(entry, calibration.calibration, head)
    _check_ranks(entries, calibration.calibration, head)
    _check_joint(calibration, head)
    _check_growth(calibration, head)
    _check_scales(calibration)
    _check_method(entries, calibration, head)
    _check_selftest(calibration)
    _check_widths(entries, calibration, head)


def selftest_sets(
    calibration: Calibration, head: Head, entries: Sequence[Threshold]
) -> list[ConformalSet]:
    """Return the set of the self-test image for each threshold, from its stored outputs.

    Widths are NaN if the method's solver finds no pose.
    """
    shapes = {spec.name: spec.shape for spec in calibration.model.outputs}
    outputs = {
        name: np.array(values, np.float32).reshape(shapes[name])
        for name, values in calibration.selftest.outputs.items()
    }
    inputs, pose, learned = calibration.preprocess, calibration.pose, calibration.camera
    seen = None
    if learned is not None:
        shape = inputs.height, inputs.width, inputs.crop
        own = crop_view(learned.height, learned.width, *shape).camera(learned)
        seen = seen_camera(learned, own, inputs.crop)
    solve = head.solver(seen)
    found = outputs if solve is None else solve(outputs).outputs
    absolute = pose.rotation == "tangent_reference"
    chart = Chart(pose.rotation, np.array(pose.reference_q_xyzw) if absolute else None)
    estimate = found["pose"].astype(np.float64)
    estimate[:, 3:] /= np.linalg.norm(estimate[:, 3:], axis=1)
    point = chart.point(estimate[0])
    return [head.conformal_set(found, point, entry) for entry in entries]


def _check_counts(source: CalibrationSpec) -> None:
    for name in ("n_sequences", "n_effective"):
        if getattr(source, name) > source.n:
            raise CalibrationFileError(
                f"calibration.{name}: expected at most n = {source.n}, found "
                f"{getattr(source, name):g}"
            )


def _check_bounded(entry: Threshold, source: CalibrationSpec, head: Head) -> None:
    """Check that a threshold is finite exactly if the counts allow it."""
    draws = Draws.of(source)
    levels = head.levels(entry, source.joint)
    for side, level in zip(("q_hat", "q_hat_upper"), levels, strict=False):
        values = getattr(entry, side)
        if level is None or values is None:
            continue
        needed = draws.needed(level)
        where = f"thresholds.{side}: expected"
        given = f"{draws.given} {draws.unit}"
        if draws.given < needed and any(value is not None for value in values):
            raise CalibrationFileError(
                f"{where} null at {_named(entry)}, which needs {needed} {draws.unit}, found "
                f"numbers from {given}"
            )
        if draws.given >= needed and None in values and head.continuous:
            raise CalibrationFileError(
                f"{where} numbers at {_named(entry)}, for which {needed} {draws.unit} suffice, "
                f"found null with {given}"
            )


def _check_ranks(entries: Sequence[Threshold], source: CalibrationSpec, head: Head) -> None:
    """Check that levels with the same rank among the frames have the same threshold.

    Recordings have no ranks: one of them counts each of its frames a little.
    """
    if recording_cap(source.rule, source.cap) is not None:
        return
    known: dict[tuple[str, str, int], Threshold] = {}
    for entry in entries:
        levels = head.levels(entry, source.joint)
        for side, level in zip(("q_hat", "q_hat_upper"), levels, strict=False):
            if level is None:
                continue
            rank = conformal_rank(source.n, level)
            first = known.setdefault((entry.scope, side, rank), entry)
            if getattr(first, side) != getattr(entry, side):
                raise CalibrationFileError(
                    f"quantiles.{entry.scope}: expected the thresholds of {first.confidence:.9g} "
                    f"at {entry.confidence:.9g}, which has the same rank among {source.n} frames, "
                    "found others"
                )


def _check_joint(calibration: Calibration, head: Head) -> None:
    """Check the order of the scopes where the joint scope has a score of its own."""
    if not head.one_joint_score:
        return
    for entry in calibration.thresholds:
        marginal = calibration.threshold(entry.confidence, "marginal")
        radius = entry.q_hat[0]
        if entry.scope != "joint" or radius is None or marginal is None:
            continue
        most = head.largest_marginal(radius)
        for dof, value in enumerate(marginal.q_hat):
            if value is None or value > most + 1e-5 * max(1.0, abs(most)):
                raise CalibrationFileError(
                    f"thresholds.q_hat: expected scope marginal at {entry.confidence:g} to be at "
                    f"most {most:.6g} beside the joint distance {radius:.6g}, found "
                    f"{'null' if value is None else f'{value:.6g}'} at [{dof}]"
                )


def _check_growth(calibration: Calibration, head: Head) -> None:
    """Check that scores differ: the middle of them is not their 90 % quantile.

    Of a few frames, it may be.
    """
    if calibration.calibration.n < _FEW:
        return
    for scope in SCOPES:
        low = calibration.threshold(_MIDDLE, scope)
        high = calibration.threshold(_HIGH, scope)
        if low is None or high is None or not head.continuous:
            continue
        for side in ("q_hat", "q_hat_upper"):
            pairs = zip(getattr(low, side) or (), getattr(high, side) or (), strict=True)
            for dof, (small, large) in enumerate(pairs):
                if large is not None and not small < large:
                    raise CalibrationFileError(
                        f"thresholds.{side}: expected more at {_HIGH:g} than at {_MIDDLE:g}, "
                        f"found {large:.6g} for both at [{dof}], scope {scope}"
                    )


def _check_scales(calibration: Calibration) -> None:
    limits = calibration.pose.limits
    for dof, deviation in enumerate(calibration.pose.standard_deviation):
        most = 0.5 * (limits.highest[dof] - limits.lowest[dof])
        if deviation > most * (1.0 + _ROUNDING):
            raise CalibrationFileError(
                "pose.standard_deviation: expected at most half of the range of pose.limits, "
                f"{most:.6g}, found {deviation:.6g} at [{dof}]"
            )


def _check_method(entries: Sequence[Threshold], calibration: Calibration, head: Head) -> None:
    """Check thresholds and parameters against what the method can have."""
    least, most = head.score_range()
    for entry in entries:
        for dof, value in enumerate(entry.q_hat):
            if value is not None and not least <= value <= most:
                raise CalibrationFileError(
                    f"thresholds.q_hat: expected {least:g} to {most:g} for {head.score} scores, "
                    f"found {value:.6g} at [{dof}], {_named(entry)}"
                )
    for limit in head.parameter_limits(calibration):
        if limit.value > limit.most:
            raise CalibrationFileError(
                f"method_parameters.{limit.key}: expected at most {limit.most:.6g}, found "
                f"{limit.value:.6g}"
            )


def _check_selftest(calibration: Calibration) -> None:
    """Check that the self-test can fail: with its tolerance, and for these outputs."""
    test, most = calibration.selftest, SELFTEST_TOLERANCE[calibration.model.precision]
    if test.tolerance > most:
        raise CalibrationFileError(
            f"selftest.tolerance: expected at most {most:g} for {calibration.model.precision}, "
            f"found {test.tolerance:g}"
        )
    values = [value for output in test.outputs.values() for value in output]
    if not max(values) - min(values) > test.tolerance:
        raise CalibrationFileError(
            f"selftest.outputs: expected numbers that differ by more than {test.tolerance:g}, "
            f"found {shown(values[0])} for all"
        )
    for name, output in test.outputs.items():
        if len(output) > 1 and min(output) == max(output):
            raise CalibrationFileError(
                f"selftest.outputs: expected numbers that differ in {name}, found "
                f"{shown(output[0])} {len(output)} times"
            )
        length = float(np.linalg.norm(output[_QUATERNIONS.get(name, slice(0))]))
        if name in _QUATERNIONS and not length > test.tolerance:
            raise CalibrationFileError(
                f"selftest.outputs: expected a quaternion in {name}, found one of length "
                f"{length:.3g}"
            )


def _check_widths(entries: Sequence[Threshold], calibration: Calibration, head: Head) -> None:
    """Check that the sets of the self-test image have a width, which grows with the level."""
    least = _LEAST_WIDTH * np.array(calibration.pose.standard_deviation)
    dof = Chart(calibration.pose.rotation).dof
    found = list(zip(entries, selftest_sets(calibration, head, entries), strict=True))
    found.sort(key=lambda each: each[0].confidence)
    for entry, each in found:
        if each.crossed:
            if entry.confidence >= _HIGH:
                raise CalibrationFileError(
                    f"thresholds: expected an interval for the self-test image at {_named(entry)}, "
                    "found bounds that cross"
                )
            continue
        # NaN widths are those of an image that no solver places; it gets no interval. The least of
        # many scores may be next to zero.
        narrow = each.width() < least
        if narrow.any() and entry.confidence >= _MIDDLE:
            first = int(narrow.argmax())
            raise CalibrationFileError(
                f"thresholds: expected a width of at least {least[first]:.3g} in {dof[first]} for "
                f"the self-test image at {_named(entry)}, found {each.width()[first]:.3g}"
            )
    for scope in SCOPES:
        rows = [(entry, each.width()) for entry, each in found if entry.scope == scope]
        for (_, before), (entry, after) in pairwise(rows):
            shrunk = after < before * (1.0 - _ROUNDING)
            if shrunk.any():
                first = int(shrunk.argmax())
                raise CalibrationFileError(
                    f"thresholds: expected the width in {dof[first]} for the self-test image to "
                    f"grow with the level, found {after[first]:.6g} after {before[first]:.6g} at "
                    f"{_named(entry)}"
                )


def _named(entry: Threshold) -> str:
    return f"{entry.confidence:g} {entry.scope}"
