"""Motions: residuals, horizons, traces, thresholds, fits."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from cvo_edge.conformal import capped_quantile
from cvo_edge.errors import UsageError
from cvo_edge.motion.errors import errors_of
from cvo_edge.motion.fitting import Normal, bias_sums, predict_bias, solve_bias
from cvo_edge.motion.horizon_fit import crossed, stretched
from cvo_edge.motion.horizons import Horizon, starts
from cvo_edge.motion.kept import Kept
from cvo_edge.motion.recordings import about, limits_of, trace_of
from cvo_edge.motion.relative import motion, norms, residual
from cvo_edge.motion.thresholds import CAP, Scores
from cvo_edge.motion.trace import Limits, column_logarithms, rows_of
from cvo_edge.motion.tube_fit import fit_tube
from cvo_edge.motion.windows import Window
from cvo_edge.spread import Here
from cvo_edge.vocabulary import MOTION_RULES

from .simulated_drives import chained, composed, drive, smooth, twist

Array = NDArray[np.float64]
NO_COLUMNS = np.empty((0, 0))


def matrix(pose: Array) -> Array:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat(pose[3:]).as_matrix()
    T[:3, 3] = pose[:3]
    return T


def any_pose(generator: np.random.Generator) -> Array:
    return np.concatenate([generator.normal(size=3), Rotation.random(rng=generator).as_quat()])


@pytest.mark.parametrize("seed", range(5))
def test_residuals_are_those_of_matrices(seed: int) -> None:
    generator = np.random.default_rng(seed)
    a, b, c, d = (any_pose(generator) for _ in range(4))
    dE, dG = (np.linalg.inv(matrix(x)) @ matrix(y) for x, y in ((a, b), (c, d)))
    off = np.linalg.inv(dE) @ dG
    x = residual(motion(a, b), motion(c, d))
    np.testing.assert_allclose(x[:3], off[:3, 3], atol=1e-12)
    np.testing.assert_allclose(x[3:], Rotation.from_matrix(off[:3, :3]).as_rotvec(), atol=1e-7)
    np.testing.assert_allclose(norms(x), [np.linalg.norm(x[:3]), np.linalg.norm(x[3:])])


def test_residuals_do_not_depend_on_the_worlds() -> None:
    generator = np.random.default_rng(0)
    estimate, truth = chained(twist(smooth(generator, 20))), chained(twist(smooth(generator, 20)))
    moved = composed(any_pose(generator), estimate), composed(any_pose(generator), truth)
    plain = residual(motion(estimate[:-3], estimate[3:]), motion(truth[:-3], truth[3:]))
    turned = residual(*(motion(poses[:-3], poses[3:]) for poses in moved))
    np.testing.assert_allclose(turned, plain, atol=1e-12)


@pytest.mark.parametrize("text", ["1f", "5s", "0.5s", "100m"])
def test_a_horizon_reads_what_it_writes(text: str) -> None:
    assert str(Horizon.parse(text)) == text


@pytest.mark.parametrize("text", ["", "s", "1", "0s", "-1s", "1.5f", "5 m", "1e9m", "nan s"])
def test_other_horizons_are_refused(text: str) -> None:
    with pytest.raises(UsageError, match=r"^horizon: expected"):
        Horizon.parse(text)


@given(
    steps=st.lists(st.floats(0.0, 3.0), min_size=1, max_size=30),
    breaks=st.sets(st.integers(1, 29)),
    value=st.floats(0.1, 10.0),
)
@settings(max_examples=100, deadline=None)
def test_a_motion_starts_where_it_fits_best(
    steps: list[float], breaks: set[int], value: float
) -> None:
    along = np.concatenate([[0.0], np.cumsum(steps)])
    part = np.cumsum([index in breaks for index in range(len(along))])
    found = starts(Horizon("m", value), along, part, np.arange(len(along)))
    for end, start in enumerate(found.tolist()):
        spans = along[end] - along[:end]
        if start < 0:
            # The best earlier pose does not fit, or lies before a break.
            best = int(np.argmin(np.abs(spans - value))) if end else 0
            fits = end and abs(spans[best] - value) <= 0.19 * value
            assert not (fits and (part[:end] == part[end]).all())
            continue
        assert part[start] == part[end]
        assert abs(spans[start] - value) <= np.abs(spans - value).min() + 1e-12


def limits() -> Limits:
    return Limits(period_s=0.05, gap_s=0.2, speed=10.0, turn=5.0)


def test_a_trace_is_the_same_pose_by_pose() -> None:
    pair = drive(1, 60)
    poses, stamps = pair.estimate.copy(), pair.stamps_ns.copy()
    poses[8:12] = poses[8]
    poses[20] = np.nan
    poses[40:, :3] += 5.0
    stamps[50:] += 10**9
    columns = np.random.default_rng(0).uniform(0.1, 2.0, (len(poses), 2))
    whole = rows_of(stamps, poses, columns, limits())
    kept = Kept(limits(), 2)
    for place, stamp in enumerate(stamps.tolist()):
        kept.add(place, stamp, poses[place].tolist(), column_logarithms(columns[place]).tolist())
    for field in ("stamps_ns", "part", "path_m"):
        np.testing.assert_array_equal(getattr(kept, field), getattr(whole, field), err_msg=field)
    for place in range(len(poses)):
        for field in ("twist", "change"):
            found = getattr(kept, field)(place)
            np.testing.assert_array_equal(found, getattr(whole, field)[place], err_msg=field)
        means = (whole.sums[place] - whole.sums[0]) / max(place, 1)
        np.testing.assert_array_equal(kept.means(0, place), means)
    # A missing pose is a part of its own; a jump and a gap each begin a part.
    assert np.flatnonzero(np.diff(whole.part)).tolist() == [19, 20, 39, 49]


def test_no_motion_crosses_a_break() -> None:
    pair = drive(2, 100)
    pair.estimate[50:, :3] += 100.0
    rows = trace_of(pair, limits(), ())
    found = errors_of(rows, pair.truth, Horizon("f", 10))
    assert not set(found.end.tolist()) & set(range(50, 60))
    assert np.abs(found.residuals[:, :3]).max() < 1.0


@pytest.mark.parametrize("confidence", [0.5, 0.8, 0.9, 0.95])
def test_thresholds_are_those_of_the_formulas(confidence: float) -> None:
    generator = np.random.default_rng(3)
    sizes, groups = (30, 50, 7, 21, 40, 33), ["a", "b", "c", "c", "d", "e"]
    scores = [generator.gamma(2.0, size=(size, 2)) for size in sizes]
    found = Scores(scores, groups)
    every = np.concatenate(scores)
    named = np.repeat(groups, sizes)
    for column in range(2):
        by_rule = {
            rule: found.thresholds(rule, confidence)[column]
            for rule in ("mean", "tolerance", "capped", "hierarchical")
        }
        for rule, cap in (("capped", CAP), ("hierarchical", 1.0)):
            assert by_rule[rule] == capped_quantile(every[:, column], named, confidence, cap)
        own = [every[named == group, column] for group in sorted(set(groups))]
        quantiles = [np.quantile(each, confidence, method="inverted_cdf") for each in own]
        assert by_rule["tolerance"] == max(quantiles)

        below = every[every[:, column] < by_rule["mean"], column].max()
        missed, too_many = (
            np.mean([np.mean(each > q) for each in own]) for q in (by_rule["mean"], below)
        )
        assert missed <= 1.0 - confidence + 1e-12 < too_many


def test_one_threshold_is_that_of_the_table() -> None:
    generator = np.random.default_rng(6)
    # Ties, recordings of other sizes and scales, and all mass in one place.
    scores = [
        generator.lognormal(0.0, 1.0, (size, 2)).round(2) * [scale, 1.0 if scale < 3 else 0.0]
        for size, scale in ((3000, 1.0), (20, 2.0), (700, 0.1), (2500, 5.0))
    ]
    found = Scores(scores, "abca")
    levels = (0.01, 0.5, 0.9, 0.999)
    table = found.table(MOTION_RULES, levels)
    for row, rule in zip(table, MOTION_RULES, strict=True):
        for expected, level in zip(row, levels, strict=True):
            np.testing.assert_array_equal(found.thresholds(rule, level), expected)
    assert np.isinf(table).any()


def test_rules_hold_for_new_recordings() -> None:
    """Recordings of different difficulty; each redraw is a new calibration and a new recording."""
    generator = np.random.default_rng(5)
    count, redraws = 11, 400
    shares: dict[str, list[float]] = {rule: [] for rule in MOTION_RULES}
    for _ in range(redraws):
        scales = generator.lognormal(0.0, 0.4, count + 1)
        *known, new = (
            scale * np.abs(generator.standard_t(4, size=(60, 1))) for scale in scales.tolist()
        )
        scores = Scores(known, [str(index) for index in range(count)])
        for rule in MOTION_RULES:
            shares[rule].append(float(np.mean(new <= scores.thresholds(rule, 0.9))))
    inside = {rule: np.array(values) for rule, values in shares.items()}
    # Three standard errors of 400 redraws are 0.04 for the tolerance and 0.015 for the others.
    assert abs(np.mean(inside["tolerance"] >= 0.9) - count / (count + 1)) < 0.045
    assert np.minimum(1.0 - inside["capped"], CAP).mean() <= 0.1 + 0.015
    assert 1.0 - inside["hierarchical"].mean() <= 0.1 + 0.015
    assert 0.87 <= inside["mean"].mean() <= 0.93


def test_the_order_of_recordings_changes_nothing() -> None:
    generator = np.random.default_rng(4)
    scores = [generator.gamma(2.0, size=(size, 3)) for size in (30, 50, 40)]
    one, other = Scores(scores, "abc"), Scores(scores[::-1], "cba")
    for rule in ("mean", "tolerance", "capped", "hierarchical"):
        np.testing.assert_array_equal(one.thresholds(rule, 0.8), other.thresholds(rule, 0.8))


def test_a_bias_that_is_linear_in_the_motion_is_found() -> None:
    bias = np.zeros((6, 6))
    bias[0, 0], bias[5, 1] = 0.3, -0.1
    pairs = [drive(seed, bias=bias) for seed in range(3)]
    rows = [trace_of(pair, limits_of(list(map(about, pairs))), ()) for pair in pairs]
    errors = [
        errors_of(row, pair.truth, Horizon("f", 1)) for row, pair in zip(rows, pairs, strict=True)
    ]
    sums = [bias_sums(each.numbers, each.residuals) for each in errors[:2]]
    found = solve_bias(Normal.plus(*sums))
    rest = errors[2].residuals - predict_bias(found, errors[2].numbers)
    before, after = (np.sqrt(np.mean(x**2, axis=0)) for x in (errors[2].residuals, rest))
    assert (after < 1.25 * np.repeat([0.002, 0.001], 3)).all()
    assert before[0] > 3.0 * after[0]


@pytest.mark.parametrize("depends", [True, False])
def test_a_tube_is_wider_where_errors_are_larger(depends: bool) -> None:
    """Errors grow with the square root of time, in half of the windows four times as fast."""
    generator = np.random.default_rng(6)
    window, along = Horizon.parse("5s"), np.linspace(0.5, 5.0, 10)
    recordings = []
    for _ in range(6):
        fast = generator.permutation(np.repeat([0.0, 1.0], 20))
        sizes = np.exp(np.log(4.0) * fast * depends)[:, np.newaxis, np.newaxis]
        errors = np.abs(generator.normal(size=(40, 10, 8))) * sizes * np.sqrt(along)[:, np.newaxis]
        numbers = generator.normal(size=(6, 40, 10))
        numbers[0], numbers[4] = fast[:, np.newaxis], np.log(along)
        recordings.append(
            Window(
                np.repeat(np.arange(40), 10),
                np.tile(along, 40),
                errors.reshape(400, 8),
                numbers.reshape(6, 400),
            )
        )
    tube = fit_tube(window, Here(recordings), "abcdef", learned=True)
    learned = tube.scale.coefficients
    if depends:
        # Small errors count as larger ones, so that the fit is flatter than the errors.
        assert (learned[1] > 0.5 * np.log(4.0)).all()
        assert (learned[1] < np.log(4.0)).all()
        np.testing.assert_allclose(learned[5], 0.5, atol=0.2)
    else:
        assert not learned[[1, 2, 3, 4, 6]].any()
    # The six degrees of freedom, each in its unit, are all inside as often as stated.
    q = Scores(tube.scores, "abcdef").thresholds("mean", 0.9)
    assert abs(np.mean(np.concatenate(tube.scores) <= q) - 0.9) < 0.01


def test_a_fold_is_fitted_on_the_others() -> None:
    sums = [Normal(np.array(2.0**place), np.zeros(1)) for place in range(4)]
    without, whole = crossed(sums, [0, 1, 1, 2], lambda each: each.left)
    assert (without, whole) == ([14.0, 9.0, 7.0], 15.0)


def test_a_flat_scale_is_stretched_and_a_fitting_one_is_not() -> None:
    generator = np.random.default_rng(8)
    samples = []
    for _ in range(8):
        spread = np.exp(0.3 * generator.normal(size=(800, 8)))
        # The first scale is flatter than the errors, the second fits, the others know nothing.
        scales = np.ones((800, 8))
        scales[:, 0], scales[:, 1] = spread[:, 0] ** 0.7, spread[:, 1]
        errors = np.abs(generator.normal(size=(800, 8))) * spread
        samples.append((errors / scales, scales))
    stretch = stretched(samples, "abcdefgh")
    assert 1.2 <= stretch.factor[0] <= 1.5
    assert stretch.factor[1] <= 1.1
    assert (stretch.factor[2:] == 1.0).all()
    assert stretch.of(samples[0][1])[:, 2:] == pytest.approx(1.0)
