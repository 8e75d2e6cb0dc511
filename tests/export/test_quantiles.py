"""Any confidence: never below the exact quantile, the stored threshold where there is one."""

import functools
import json
import subprocess
import sys

import numpy as np
import pytest
from msgspec.structs import replace

from cvo_edge import CalibrationFileError, Odometer, UsageError
from cvo_edge.bundle.quantiles import reaches, table_entries, threshold_at
from cvo_edge.bundle.reading import (
    MAX_CALIBRATION_BYTES,
    decode_calibration,
    encode_calibration,
    read_calibration,
)
from cvo_edge.heads import HEADS
from cvo_edge.heads.checked import checked_head
from cvo_edge.heads.plausible import check_plausible
from cvo_edge.programs.inspect import inspect_lines
from cvo_edge.programs.verify import verify_bundle
from cvo_edge.vocabulary import SCOPES
from cvo_export.bundles.quantiles import with_quantiles
from cvo_export.bundles.thresholds import Quantiles, Scored


@functools.cache
def demonstration(artifacts_dir, method, sides="symmetric"):
    found = read_calibration(artifacts_dir / f"synthetic-room-{method}")
    if sides != "symmetric":
        found = replace(found, method_parameters={**found.method_parameters, "sides": sides})
    return found


def made(base, scores, sequence, rule="pooled", cap=None, joint="max"):
    """A calibration of a demonstration's network with these scores (n, sides, 6), and its rule."""
    kind = HEADS[base.method]
    head = kind(base.parameters(kind.parameters_type), base.calibration.score)
    together = np.tile(3.0 * scores.max(axis=2, keepdims=True), (1, 1, 6))
    scored = Scored(scores, together if head.one_joint_score else scores, sequence)
    exact = Quantiles(head, scored, scored, rule, joint, cap)
    source = replace(
        base.calibration,
        n=len(scores),
        n_sequences=len(np.unique(sequence)),
        n_effective=1.0,
        rule=rule,
        cap=cap,
        joint=joint,
    )
    stored = replace(base, calibration=source, thresholds=exact.entries())
    return with_quantiles(stored, head, exact.bounds), exact, head


def numbers(entry):
    """The thresholds of an entry, (sides, 6), infinite where unbounded."""
    rows = [row for row in (entry.q_hat, entry.q_hat_upper) if row is not None]
    return np.array([[np.inf if q is None else q for q in row] for row in rows])


CASES = [
    ("cjp", "symmetric", "pooled", None, "max"),
    ("cjp", "symmetric", "capped", 0.5, "bonferroni"),
    ("cqr", "asymmetric", "pooled", None, "bonferroni"),
    ("cqr", "asymmetric", "capped", 0.25, "max"),
    ("cqr", "lower", "hierarchical", None, "max"),
    ("csp", "symmetric", "pooled", None, "max"),
    ("mcqr", "symmetric", "hierarchical", None, "max"),
    ("scr", "symmetric", "capped", 1.0, "max"),
]


@pytest.mark.parametrize("n", [5, 30, 700])
@pytest.mark.parametrize(("method", "sides", "rule", "cap", "joint"), CASES)
def test_a_threshold_is_never_below_the_exact_one(
    artifacts_dir, method, sides, rule, cap, joint, n
):
    generator = np.random.default_rng(n)
    base = demonstration(artifacts_dir, method, sides)
    number = 1 if sides == "symmetric" else 2
    scores = generator.beta(3.0, 0.7, (n, number, 6))
    if method == "csp":
        # Truths outside the workspace, and classes that tie.
        scores = np.round(scores, 3)
        scores[: n // 30, 0, 2] = np.inf
    calibration, exact, _ = made(
        base, scores, np.sort(generator.integers(0, max(3, n // 7), n)), rule, cap, joint
    )
    content = encode_calibration(calibration)
    assert len(content) <= MAX_CALIBRATION_BYTES
    calibration = decode_calibration(content)
    check_plausible(calibration, checked_head(calibration))
    assert calibration.quantiles is not None
    if sides == "symmetric" and method not in ("mcqr", "scr"):
        for confidence in generator.uniform(0.0, 1.0, 40):
            each, six = (numbers(threshold_at(calibration, confidence, scope)) for scope in SCOPES)
            with np.errstate(invalid="ignore"):
                assert not (six < each - 1e-9).any()
    for entry in calibration.thresholds:
        assert threshold_at(calibration, entry.confidence, entry.scope) == entry
    for reach in reaches(calibration):
        wanted = np.sort(generator.uniform(0.5, 1.0, 60))
        found = [numbers(threshold_at(calibration, each, reach.scope)) for each in wanted]
        least = exact.bounds(wanted.tolist(), reach.scope)
        before = numbers(threshold_at(calibration, 0.2, reach.scope))
        for confidence, q, lowest in zip(wanted, found, least, strict=True):
            assert (q >= lowest).all()
            assert (q >= before).all()
            if method != "csp":
                assert np.isfinite(q).all(axis=1).any() == (confidence <= reach.confidence)
            before = q
        # Nothing finite is lost, but for a step of the stored confidences.
        beyond = exact.bounds([min(1.0 - 1e-9, reach.confidence + 1e-6)], reach.scope)[0]
        assert np.isinf(beyond).any()


@pytest.mark.parametrize("n", [19, 60, 200])
def test_thresholds_are_those_of_numpy_rank_by_rank(artifacts_dir, n):
    """Where every score above the middle is kept, rounding adds a twentieth of a step at most."""
    scores = np.random.default_rng(n).gamma(2.0, 1.0, (n, 1, 6))
    calibration, _, _ = made(demonstration(artifacts_dir, "cjp"), scores, np.arange(n))
    ascending = np.sort(scores[:, 0], axis=0)
    for confidence in (0.5, 0.613, 0.8, 0.9, 0.905, 0.925, 0.95):
        rank = int(np.ceil((n + 1) * confidence - 1e-9))
        if rank > n:
            continue
        expected = np.quantile(scores[:, 0], (rank - 1) / (n - 1), axis=0, method="higher")
        np.testing.assert_allclose(expected, ascending[rank - 1])
        found = numbers(threshold_at(calibration, confidence, "marginal"))[0]
        if confidence in (0.5, 0.8, 0.9, 0.95):
            np.testing.assert_array_equal(found, ascending[rank - 1])
        step = ascending[min(rank, n - 1)] - ascending[rank - 1]
        assert (found >= ascending[rank - 1]).all()
        assert (found <= ascending[rank - 1] + 0.05 * step + 1e-12).all()


@pytest.mark.parametrize(("rule", "cap", "n"), [("pooled", None, 60), ("capped", 0.5, 90)])
def test_coverage_at_a_confidence_that_is_not_stored(artifacts_dir, rule, cap, n, monkeypatch):
    """Uniform scores: the coverage of a new frame is the threshold itself, or its share."""
    monkeypatch.setattr("cvo_export.bundles.thresholds.left_out", lambda *_: None)
    generator = np.random.default_rng(5)
    base, covered = demonstration(artifacts_dir, "cjp"), []
    recordings = n if cap is None else 15
    for _ in range(100):
        hardness = np.ones(recordings) if cap is None else generator.uniform(0.3, 1.0, recordings)
        sequence = np.sort(np.arange(n) % recordings)
        scores = generator.uniform(0.0, 1.0, (n, 1, 6)) * hardness[sequence][:, None, None]
        q = numbers(threshold_at(made(base, scores, sequence, rule, cap)[0], 0.925, "marginal"))
        new = 1.0 if cap is None else generator.uniform(0.3, 1.0)
        covered.append(np.minimum(q[0] / new, 1.0).mean())
    error = np.std(covered) / np.sqrt(len(covered))
    assert np.mean(covered) >= 0.925 - 3 * error
    if cap is None:
        assert np.mean(covered) <= 0.925 + 1.05 / (n + 1) + 3 * error


@pytest.fixture
def with_table(copied_bundle, rewrite, bundle):
    """The copied bundle with quantiles: between stored levels, the next larger threshold."""
    stored = bundle.calibration

    def bounds(confidences, scope):
        levels = [e for e in stored.thresholds if e.scope == scope]
        rows = [next((e for e in levels if e.confidence >= c), None) for c in confidences]
        return np.array([[[np.inf] * 6] if e is None else numbers(e) for e in rows])

    few = replace(stored.calibration, n=99, n_effective=9.0)
    calibration = with_quantiles(replace(stored, calibration=few), bundle.head, bounds)
    if calibration.quantiles is None:
        raise AssertionError("the table does not fit")
    return rewrite(calibration)


def test_a_run_has_the_confidence_that_it_asks_for(with_table, clip_dir, bundle_dir, tmp_path):
    def run(folder, confidence):
        arguments = ["run", folder, clip_dir, "--max-frames", 3, "--confidence", confidence]
        code = "from cvo_edge.__main__ import main; main()"
        return subprocess.run(
            [sys.executable, "-c", code, *map(str, arguments), "--quiet", "-o", "-"],
            capture_output=True,
            text=True,
            check=False,
        )

    lines = [json.loads(line) for line in run(with_table, 0.925).stdout.splitlines()]
    assert lines[1]["interval"]["confidence"] == 0.925
    refused = run(bundle_dir, 0.925)
    assert refused.returncode == 2
    assert "0.925 is not stored" in refused.stderr
    assert "nearest: 0.9 and 0.95" in refused.stderr
    with Odometer.load(with_table, confidence=0.925) as odometer:
        calibration = odometer.calibration
        assert odometer.threshold.q_hat == threshold_at(calibration, 0.95, "marginal").q_hat
    for confidence in (0.0, 1.0, -0.1, float("nan"), "high"):
        with pytest.raises(UsageError, match="confidence: expected a number"):
            Odometer.load(with_table, confidence=confidence)
    verify_bundle(with_table, threads=1)
    assert "confidences  any, by" in "\n".join(inspect_lines(read_calibration(with_table)))


def altered(table, scope, change):
    columns = [
        None if each is None else tuple(change(place, q) for place, q in enumerate(each))
        for each in getattr(table, scope)
    ]
    return replace(table, **{scope: tuple(columns)})


@pytest.mark.parametrize(
    ("lie", "words"),
    [
        (lambda t: altered(t, "marginal", lambda _, q: q and 0.9 * q), "between its neighbours"),
        (lambda t: altered(t, "joint", lambda _, q: q and 1.1 * q), "between its neighbours"),
        (lambda t: altered(t, "joint", lambda i, q: 0.0 if i == 3 else q), "grow with the conf"),
        (lambda t: replace(t, confidences=t.confidences[::-1]), "expected ascending"),
        (lambda t: replace(t, confidences=t.confidences[:-1]), "one number for each"),
        (lambda t: replace(t, marginal=t.marginal[:5]), "expected 6 lists"),
    ],
)
def test_quantiles_that_contradict_the_thresholds_are_refused(artifacts_dir, lie, words):
    scores = np.random.default_rng(1).gamma(2.0, 1.0, (150, 1, 6))
    calibration, _, _ = made(demonstration(artifacts_dir, "cjp"), scores, np.arange(150))
    content = encode_calibration(calibration)
    with pytest.raises(CalibrationFileError, match=words):
        encode_calibration(replace(calibration, quantiles=lie(calibration.quantiles)))
    # An earlier release reads neither the key nor a file of version 2, and says which it needs.
    assert json.loads(content)["schema_version"] == 2
    for version, table in ((1, calibration.quantiles), (2, None)):
        with pytest.raises(
            CalibrationFileError, match=r"schema_version: expected [12] for a bundle"
        ):
            encode_calibration(replace(calibration, schema_version=version, quantiles=table))


@pytest.mark.parametrize("n", [140, 160])
def test_another_number_of_frames_does_not_fit_the_ranks(artifacts_dir, n):
    scores = np.random.default_rng(1).gamma(2.0, 1.0, (150, 1, 6))
    calibration, _, head = made(demonstration(artifacts_dir, "cjp"), scores, np.arange(150))
    check_plausible(calibration, head)
    assert all(entry.confidence < 150.5 / 151 for entry in table_entries(calibration))
    source = replace(calibration.calibration, n=n, n_sequences=1)
    with pytest.raises(CalibrationFileError, match=r"the same rank|which needs|suffice"):
        check_plausible(replace(calibration, calibration=source), head)
    assert {entry.scope for entry in table_entries(calibration)} == set(SCOPES)


def test_factors_below_zero_are_refused_at_any_confidence(artifacts_dir):
    scores = np.random.default_rng(1).gamma(2.0, 1.0, (150, 1, 6))
    calibration, _, head = made(demonstration(artifacts_dir, "cjp"), scores, np.arange(150))
    table = altered(calibration.quantiles, "marginal", lambda place, q: q if place else -1.0)
    lie = decode_calibration(encode_calibration(replace(calibration, quantiles=table)))
    with pytest.raises(CalibrationFileError, match="expected factors of at least 0 for normalised"):
        check_plausible(lie, head)


def test_a_bundle_without_room_stays_as_it_was(artifacts_dir, monkeypatch):
    scores = np.random.default_rng(1).gamma(2.0, 1.0, (150, 1, 6))
    monkeypatch.setattr("cvo_edge.bundle.reading.MAX_CALIBRATION_BYTES", 9000)
    calibration, _, _ = made(demonstration(artifacts_dir, "cjp"), scores, np.arange(150))
    assert (calibration.schema_version, calibration.quantiles) == (1, None)
