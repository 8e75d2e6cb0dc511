"""Bundles whose numbers lie although all digests fit: refused before the model is loaded."""

import functools
from contextlib import nullcontext

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from cvo_edge import CalibrationFileError
from cvo_edge.bundle.format import CONFIDENCES
from cvo_edge.bundle.quantiles import threshold_at
from cvo_edge.bundle.reading import decode_calibration, encode_calibration, read_calibration
from cvo_edge.conformal import capped_quantile, conformal_quantile
from cvo_edge.heads.checked import checked_head
from cvo_edge.heads.cqr import CqrHead, CqrParameters
from cvo_edge.heads.difficulty import Difficulty
from cvo_edge.heads.plausible import Draws, check_plausible
from cvo_edge.programs.inspect import inspect_lines

METHODS = ("cjp", "cjp-int8", "cqr", "cqr-int8", "csp", "csp-int8", "mcqr", "mcqr-int8")
METHODS += ("scr", "scr-int8")


@functools.cache
def honest(artifacts_dir, method):
    return read_calibration(artifacts_dir / f"synthetic-room-{method}")


def check(calibration):
    """Write, read and check a calibration, with a digest that fits."""
    read = decode_calibration(encode_calibration(calibration))
    check_plausible(read, checked_head(read))


@pytest.mark.parametrize("method", METHODS)
def test_honest_bundles_pass(artifacts_dir, method):
    check(honest(artifacts_dir, method))


def each(change):
    """A lie that changes every q_hat that is a number, given the entry and the number."""

    def lie(calibration):
        return replace(
            calibration,
            thresholds=tuple(
                replace(
                    entry, q_hat=tuple(q if q is None else change(entry, q) for q in entry.q_hat)
                )
                for entry in calibration.thresholds
            ),
        )

    return lie


def at(confidence, scope, q_hat):
    """A lie that replaces one threshold."""

    def lie(calibration):
        return replace(
            calibration,
            thresholds=tuple(
                replace(entry, q_hat=q_hat)
                if (entry.confidence, entry.scope) == (confidence, scope)
                else entry
                for entry in calibration.thresholds
            ),
        )

    return lie


def swapped(calibration):
    """The thresholds of 0.5 and 0.95 change places."""
    other = {0.5: 0.95, 0.95: 0.5}
    return replace(
        calibration,
        thresholds=tuple(
            replace(entry, confidence=other.get(entry.confidence, entry.confidence))
            for entry in calibration.thresholds
        ),
    )


def scopes_swapped(calibration):
    other = {"marginal": "joint", "joint": "marginal"}
    thresholds = (replace(entry, scope=other[entry.scope]) for entry in calibration.thresholds)
    return replace(calibration, thresholds=tuple(thresholds))


def one_joint(radius):
    """The same joint distance at every level that has one."""
    return lambda calibration: each(lambda entry, q: radius if entry.scope == "joint" else q)(
        calibration
    )


def counted(**values):
    return lambda c: replace(c, calibration=replace(c.calibration, **values))


def self_tested(**values):
    return lambda c: replace(c, selftest=replace(c.selftest, **values))


def answered(name, values):
    """A lie about one output for the self-test image."""
    return lambda c: self_tested(outputs={**c.selftest.outputs, name: values})(c)


def all_answered(change):
    """A lie about every output for the self-test image, given its number of values."""
    return lambda c: self_tested(
        outputs={name: change(len(values)) for name, values in c.selftest.outputs.items()}
    )(c)


def with_parameters(**values):
    return lambda c: replace(c, method_parameters={**c.method_parameters, **values})


def additive(*lies):
    """The additive score, and further lies."""

    def lie(calibration):
        calibration = counted(score="additive")(calibration)
        for one in lies:
            calibration = one(calibration)
        return calibration

    return lie


def spread(deviation):
    return lambda c: replace(c, pose=replace(c.pose, standard_deviation=(deviation,) * 6))


def null_everywhere(calibration):
    thresholds = (replace(entry, q_hat=(None,) * 6) for entry in calibration.thresholds)
    return replace(calibration, thresholds=tuple(thresholds))


LIES = {
    "all widths zero": (
        "cjp",
        each(lambda entry, q: 0.0 if entry.confidence < 0.9 else 1e-12 * entry.confidence),
        "expected a width of at least 1.74e-07 in tx for the self-test image at 0.5 marginal, "
        "found 0",
    ),
    "widths of next to nothing": ("cjp", each(lambda e, q: 1e-9 * q), "expected a width of at"),
    "widths of next to nothing, of a region": (
        "mcqr",
        each(lambda e, q: 1e-9 * q),
        "expected a width of at least 1.74e-07 in tx for the self-test image at 0.5 marginal",
    ),
    "zero factors of a solver": (
        "scr",
        each(lambda e, q: 0.0),
        "expected more at 0.9 than at 0.5, found 0 for both at [0], scope marginal",
    ),
    "next to no factors of a solver": (
        "scr",
        each(lambda e, q: 1e-12 * q),
        "expected 1e-09 to inf for normalised scores, found 1.",
    ),
    "bounds that cross in every frame": (
        "cjp",
        additive(each(lambda entry, q: -1e3 / q)),
        "expected an interval for the self-test image at 0.9 marginal, found bounds that cross",
    ),
    "confidences swapped": ("cjp", swapped, "expected values that grow with the confidence"),
    "confidences swapped, for a solver": ("scr", swapped, "expected values that grow with the"),
    "scopes swapped": ("cjp", scopes_swapped, "expected scope joint at 0.5 to be at least"),
    "scopes swapped, for classes": ("csp", scopes_swapped, "expected scope joint at 0.5 to be"),
    "a joint distance below the marginal factors": (
        "scr",
        each(lambda entry, q: 0.1 * q if entry.scope == "joint" else q),
        "expected scope marginal at 0.5 to be at most 0.4",
    ),
    "a region whose hull is below the marginal intervals": (
        "mcqr",
        each(lambda entry, q: 0.1 * q if entry.scope == "joint" else q),
        "expected scope marginal at 0.8 to be at most 1 beside the joint distance ",
    ),
    "a narrow region beside wider marginal bounds": (
        "mcqr",
        additive(each(lambda entry, q: 0.01 * q if entry.scope == "joint" else q)),
        "expected scope marginal at 0.5 to be at most 0 beside the joint distance ",
    ),
    "the same threshold at every level": (
        "cjp",
        each(lambda entry, q: 1.0 if entry.scope == "marginal" else q),
        "expected more at 0.9 than at 0.5, found 1 for both at [0], scope marginal",
    ),
    "one region at every level": (
        "mcqr",
        one_joint(9.0),
        "expected more at 0.9 than at 0.5, found 9 for both at [0], scope joint",
    ),
    "a finite level from nowhere": (
        "cjp",
        at(0.99, "marginal", (1e3,) * 6),
        "thresholds.q_hat: expected null at 0.99 marginal, which needs 49 recordings, found "
        "numbers from 20 recordings",
    ),
    "recordings inflated": (
        "cjp",
        counted(n_sequences=500),
        "thresholds.q_hat: expected numbers at 0.99 marginal, for which 49 recordings suffice, "
        "found null with 500 recordings",
    ),
    "frames inflated, and counted as draws": (
        "cjp",
        counted(n=10**6, rule="pooled", cap=None),
        "expected numbers at 0.99 marginal, for which 99 frames suffice, found null with 1000000",
    ),
    "fewer recordings than the level needs": (
        "scr",
        counted(n_sequences=3),
        "which needs 4 recordings, found numbers from 3 recordings",
    ),
    "more recordings than frames": (
        "cqr",
        counted(n_sequences=1001),
        "calibration.n_sequences: expected at most n = 1000, found 1001",
    ),
    "more independent frames than frames": (
        "cqr",
        counted(n_effective=1e8),
        "calibration.n_effective: expected at most n = 1000, found 1e+08",
    ),
    "unbounded although the counts suffice": (
        "cjp",
        null_everywhere,
        "expected numbers at 0.5 marginal, for which 1 recordings suffice, found null with 20",
    ),
    "a self-test that nothing fails": (
        "cjp",
        self_tested(tolerance=1.0),
        "selftest.tolerance: expected at most 0.001 for fp32, found 1",
    ),
    "a self-test of 8 bits that nothing fails": (
        "cjp-int8",
        self_tested(tolerance=0.5),
        "selftest.tolerance: expected at most 0.01 for int8, found 0.5",
    ),
    "a self-test of zeros": (
        "cjp",
        all_answered(lambda count: (0.0,) * count),
        "selftest.outputs: expected numbers that differ by more than 0.001, found 0.0 for all",
    ),
    "a self-test of nearly equal numbers": (
        "cqr",
        all_answered(lambda count: tuple(0.5 + 1e-5 * i for i in range(count))),
        "selftest.outputs: expected numbers that differ by more than 0.001, found 0.5 for all",
    ),
    "a constant output": (
        "csp",
        lambda c: answered("probabilities", (1 / 128,) * 768)(c),
        "selftest.outputs: expected numbers that differ in probabilities, found 0.0078125 768",
    ),
    "a pose without rotation": (
        "mcqr",
        answered("pose", (1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 0.0)),
        "selftest.outputs: expected a quaternion in pose, found one of length 0",
    ),
    "a floor wider than the place": (
        "cjp",
        with_parameters(half_width_floor=[1e6] * 6),
        "method_parameters.half_width_floor[0]: expected at most 0.174358, found 1e+06",
    ),
    "a floor of a region wider than the place": (
        "mcqr",
        with_parameters(half_width_floor=[1e6] * 6),
        "method_parameters.half_width_floor[0]: expected at most 0.174358, found 1e+06",
    ),
    "deviations wider than the place": (
        "scr",
        with_parameters(deviation_floor=[10.0] * 6),
        "method_parameters.deviation_floor[0]: expected at most 0.174358, found 10",
    ),
    "limits that refuse no frame": (
        "scr",
        with_parameters(limits={"error_px": 1e6, "contradicting": 0.4}),
        "method_parameters.limits.error_px: expected at most 256, found 1e+06",
    ),
    "limits that refuse no contradiction": (
        "scr",
        with_parameters(limits={"error_px": 0.5, "contradicting": 1.0}),
        "method_parameters.limits.contradicting: expected at most 0.5, found 1",
    ),
    "poses spread wider than their limits": (
        "cjp",
        spread(1e6),
        "pose.standard_deviation: expected at most half of the range of pose.limits, 0.760842, "
        "found 1e+06 at [0]",
    ),
    "class scores above all classes": (
        "csp",
        each(lambda entry, q: 2.0 + q),
        "expected 0.001 to 1.001 for aps scores, found 2.",
    ),
    "class scores below all classes": (
        "csp",
        each(lambda entry, q: q - 5.0),
        "expected 0.001 to 1.001 for aps scores, found -4.",
    ),
}


@pytest.mark.parametrize("lie", LIES)
def test_a_lie_is_refused_with_one_line_that_names_it(artifacts_dir, lie):
    method, tell, words = LIES[lie]
    with pytest.raises(CalibrationFileError) as caught:
        check(tell(honest(artifacts_dir, method)))
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_inspect_shows_what_a_person_would_check(artifacts_dir):
    shown = inspect_lines(honest(artifacts_dir, "cjp"))
    assert any("1000 frames of 20 sequence(s)" in line for line in shown)
    assert any(line.startswith("self-test    650x418, 24 numbers within 0.001") for line in shown)
    (at,) = (number for number, line in enumerate(shown) if line.startswith("width, self-test"))
    widths = [line.split()[2:] for line in shown[at + 1 :]]
    assert [len(row) for row in widths] == [6] * 8  # four bounded levels, both scopes
    # The bounds' half-widths at the self-test image, times the factor of 0.9 marginal and the
    # difficulty of that image.
    calibration = honest(artifacts_dir, "cjp")
    test = calibration.selftest.outputs
    factor = threshold_at(calibration, 0.9, "marginal").q_hat[0]
    novelty = {"novelty": np.array([test["novelty"]])}
    factor *= Difficulty(calibration.difficulty).factors(novelty)[0]
    assert float(widths[4][0]) == pytest.approx(
        factor * (test["upper"][0] - test["lower"][0]), abs=1e-5
    )


def test_inspect_tells_what_verify_refuses(artifacts_dir):
    shown = inspect_lines(counted(n_effective=1e8)(honest(artifacts_dir, "cqr")))
    text = " ".join(" ".join(shown).split())
    assert "refused by verify: calibration.n_effective: expected at most n = 1000" in text


@given(sizes=st.lists(st.integers(1, 30), min_size=1, max_size=130), data=st.data())
def test_the_counts_tell_which_thresholds_the_rules_make_finite(artifacts_dir, sizes, data):
    """An oracle: the quantiles themselves, of scores without ties."""
    sequence = [number for number, size in enumerate(sizes) for _ in range(size)]
    scores = list(range(len(sequence)))
    level = data.draw(st.sampled_from((*CONFIDENCES, 0.975, 1 - 0.1 / 6, 1 - 0.5 / 12)))
    source = honest(artifacts_dir, "cjp").calibration
    source = replace(source, n=len(sequence), n_sequences=len(sizes))
    for rule, cap, q_hat in (
        ("pooled", None, conformal_quantile(scores, level)),
        ("capped", 0.5, capped_quantile(scores, sequence, level, 0.5)),
        ("hierarchical", None, capped_quantile(scores, sequence, level, 1.0)),
    ):
        draws = Draws.of(replace(source, rule=rule, cap=cap))
        assert (draws.given >= draws.needed(level)) == (q_hat < float("inf"))


@pytest.mark.parametrize("rule", ["pooled", "hierarchical"])
@pytest.mark.parametrize("joint", ["max", "bonferroni"])
@pytest.mark.parametrize("sides", ["symmetric", "asymmetric", "lower", "upper"])
def test_thresholds_fit_the_counts_that_made_them_and_no_others(
    artifacts_dir, sides, joint, rule, monkeypatch
):
    """What the exporter makes of few frames passes, and with another count it is refused."""
    exporter = pytest.importorskip("cvo_export.bundles.thresholds")
    # Its coverage without each of 600 recordings, 600 times as much work, is not what is checked.
    monkeypatch.setattr(exporter, "left_out", lambda *_: None)
    base = with_parameters(sides=sides)(honest(artifacts_dir, "cqr"))
    head = CqrHead(base.parameters(CqrParameters), "normalised")
    number = len(head.side_confidences(0.9))
    made = {}
    for n in (1, 9, 11, 19, 40, 60, 119, 599, 600):
        scores = np.random.default_rng(n).uniform(0.5, 3.0, (n, number, 6))
        scored = exporter.Scored(scores, scores, np.arange(n))
        entries = exporter.Quantiles(head, scored, scored, rule, joint).entries()
        made[n] = entries, [(None in e.q_hat, None in (e.q_hat_upper or ())) for e in entries]
    for count, (_, there) in made.items():
        source = replace(
            base.calibration,
            n=count,
            n_sequences=count,
            n_effective=1.0,
            rule=rule,
            cap=None,
            joint=joint,
        )
        for entries, unbounded in made.values():
            told = replace(base, calibration=source, thresholds=entries)
            with nullcontext() if unbounded == there else pytest.raises(CalibrationFileError):
                check_plausible(told, head)
