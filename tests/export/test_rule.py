"""The rule of a calibration: defaults, caps, and coverage without one recording."""

import numpy as np
import pytest

from cvo_edge.conformal import capped_quantile, conformal_quantile
from cvo_edge.errors import UsageError
from cvo_export.bundles.observed import Scored
from cvo_export.bundles.rule import chosen_rule
from cvo_export.bundles.thresholds import Quantiles

CQR = {"half_width_floor": [0.01] * 6, "sides": "symmetric"}


@pytest.mark.parametrize(
    ("rule", "cap", "kind", "found"),
    [
        (None, None, "sequence", ("capped", 0.5)),
        (None, 0.25, "sequence", ("capped", 0.25)),
        (None, None, "block", ("pooled", None)),
        (None, None, "random", ("pooled", None)),
        ("capped", None, "random", ("capped", 0.5)),
        ("capped", 1.0, "sequence", ("capped", 1.0)),
        ("hierarchical", None, "sequence", ("hierarchical", None)),
    ],
)
def test_a_split_by_sequence_is_capped_by_default(rule, cap, kind, found):
    assert chosen_rule(rule, cap, kind) == found


@pytest.mark.parametrize(
    ("rule", "cap", "text"),
    [
        ("pooled", 0.5, "cap: expected only with the rule capped, found 0.5 with pooled"),
        (None, 0.5, "cap: expected only with the rule capped, found 0.5 with pooled"),
        ("hierarchical", 1.0, "cap: expected only with the rule capped, found 1 with hierarchical"),
        ("capped", 0.0, "cap: expected a number above 0 and at most 1, found 0"),
        ("capped", 1.5, "cap: expected a number above 0 and at most 1, found 1.5"),
    ],
)
def test_a_cap_that_does_not_fit_is_refused(rule, cap, text):
    with pytest.raises(UsageError) as caught:
        chosen_rule(rule, cap, "random")
    assert str(caught.value) == text


@pytest.fixture(scope="module")
def scored():
    """Scores (120, 1, 6) of eight recordings of different lengths and difficulty."""
    generator = np.random.default_rng(3)
    sequence = generator.permutation(np.repeat(np.arange(8), [3, 9, 12, 15, 16, 20, 21, 24]))
    marginal = np.abs(generator.standard_normal((120, 1, 6))) * (1.0 + sequence[:, None, None])
    return Scored(marginal, marginal, sequence)


@pytest.mark.parametrize(
    ("rule", "cap", "quantile"),
    [
        ("pooled", None, lambda s, g: conformal_quantile(s, 0.9)),
        ("capped", 0.5, lambda s, g: capped_quantile(s, g, 0.9, 0.5)),
    ],
)
def test_the_coverage_left_out_is_that_of_each_recording_by_the_others(
    make_head, scored, rule, cap, quantile
):
    head = make_head("cqr", "additive", CQR)
    found = {
        entry.scope: entry.left_out
        for entry in Quantiles(head, scored, scored, rule, "max", cap).entries()
        if entry.confidence == 0.9
    }
    scores, sequence = scored.marginal[:, 0], scored.sequence
    scales = np.quantile(scores, 0.9, axis=0)
    largest = (scores / scales).max(axis=1)
    each, together = [], []
    for number in range(8):
        rest, own = sequence != number, sequence == number
        limits = [quantile(column[rest], sequence[rest]) for column in scores.T]
        each.append(np.mean([np.mean(scores[own, d] <= limits[d]) for d in range(6)]))
        together.append(np.mean(largest[own] <= quantile(largest[rest], sequence[rest])))
    for scope, shares in (("marginal", each), ("joint", together)):
        assert found[scope].coverage == pytest.approx(np.mean(shares), abs=1e-12)
        error = np.sqrt(np.var(shares, ddof=1) / 8)
        assert found[scope].standard_error == pytest.approx(error, abs=1e-12)


def test_no_coverage_is_given_where_the_others_are_too_few(make_head, scored):
    head = make_head("cqr", "additive", CQR)
    # Finite from nine recordings at 0.9, so that eight have none to be measured with.
    full = Quantiles(head, scored, scored, "hierarchical", "max").entries()
    assert {entry.confidence for entry in full if entry.left_out is not None} == {0.5, 0.8}
    one = scored._replace(sequence=np.zeros(120, np.int64))
    assert all(e.left_out is None for e in Quantiles(head, one, one, "pooled", "max").entries())
