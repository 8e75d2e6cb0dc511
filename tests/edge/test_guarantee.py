"""The sentence about each stored level: what is proven, for which rule, split and sides."""

import msgspec
import pytest

from cvo_edge.bundle.format import LeftOut, Threshold
from cvo_edge.guarantee import by_level, statement
from cvo_edge.programs.inspect import inspect_lines

FINITE, UNBOUNDED = (1.0,) * 6, (None,) * 6
PARAMETERS = {"half_width_floor": [0.01] * 6, "sides": "symmetric"}


@pytest.fixture
def said(bundle, make_head):
    """The statement of a CQR bundle with these changes to its calibration."""

    def say(
        confidence=0.9, scope="marginal", q_hat=FINITE, upper=None, sides="symmetric", **changes
    ):
        kind = changes.pop("kind", "sequence")
        source = bundle.calibration.calibration
        split = msgspec.structs.replace(source.split, kind=kind)
        defaults = {"rule": "pooled", "cap": None, "n": 500, "n_sequences": 11}
        source = msgspec.structs.replace(source, split=split, **{**defaults, **changes})
        head = make_head(
            "cqr", "additive", {**PARAMETERS, "sides": sides}, q_hat, upper, scope, source.joint
        )
        entry = Threshold(confidence=confidence, scope=scope, q_hat=q_hat, q_hat_upper=upper)
        return statement(source, head, entry)

    return say


OVER = "over new recordings, on average at most {} of frames are missed"
HALF = ", where a recording that misses more than half counts as half (in full: {})"
EQUAL = "over new recordings of equal length, on average at most {} of frames are missed"
STATED = [
    # One recording in 12 may be the new one: .1 + .9/12.
    ({}, EQUAL.format("17.5 %")),
    ({"scope": "joint"}, EQUAL.format("17.5 %")),
    ({"confidence": 0.99, "n_sequences": 99}, EQUAL.format("2 %")),
    ({"rule": "capped", "cap": 0.5}, OVER.format("10 %") + HALF.format("14.2 %")),
    (
        {"rule": "capped", "cap": 0.25, "confidence": 0.95, "n_sequences": 4},
        OVER.format("5 %")
        + ", where a recording that misses more than a quarter counts as a quarter (in full: 20 %)",
    ),
    (
        {"rule": "capped", "cap": 0.3, "n_sequences": 13},
        OVER.format("10 %")
        + ", where a recording that misses more than 30 % counts as 30 % (in full: 15 %)",
    ),
    ({"rule": "capped", "cap": 1.0}, OVER.format("10 %")),
    ({"rule": "hierarchical"}, OVER.format("10 %")),
    # Each side may miss by the new recording's misses: .1 + 2 * .5/12; six times as many below.
    (
        {"rule": "capped", "cap": 0.5, "sides": "asymmetric", "upper": FINITE},
        OVER.format("10 %") + HALF.format("18.4 %"),
    ),
    (
        {"rule": "capped", "cap": 0.5, "scope": "joint", "joint": "bonferroni"},
        OVER.format("10 %") + HALF.format("35 %"),
    ),
    (
        {"scope": "joint", "joint": "bonferroni", "n_sequences": 4},
        "nothing is proven over new recordings, from 4",
    ),
    (
        {"kind": "random"},
        "of frames exchangeable with the calibration frames, on average at most 10 % are missed",
    ),
    ({"kind": "block"}, "nothing is proven: neighbouring frames depend on each other"),
    (
        {"kind": "block", "rule": "hierarchical"},
        "nothing is proven: in a block split, recordings are shared among the roles",
    ),
    (
        {"q_hat": UNBOUNDED, "rule": "capped", "cap": 0.5, "n_sequences": 3},
        "unbounded; finite from 4 calibration recordings, has 3",
    ),
    (
        {"q_hat": UNBOUNDED, "confidence": 0.99, "rule": "hierarchical"},
        "unbounded; finite from 99 calibration recordings, has 11",
    ),
    (
        {"q_hat": UNBOUNDED, "n": 8, "kind": "random"},
        "unbounded; finite from 9 calibration frames, has 8",
    ),
    (
        {"q_hat": (*FINITE[:5], None), "rule": "hierarchical"},
        OVER.format("10 %") + "; unbounded where too many calibration truths have an infinite "
        "score",
    ),
    # The free side is no bound that could be unbounded.
    (
        {"rule": "hierarchical", "sides": "lower", "upper": UNBOUNDED},
        OVER.format("10 %"),
    ),
]


@pytest.mark.parametrize(("changes", "text"), STATED)
def test_each_rule_and_split_says_what_is_proven(said, changes, text):
    assert said(**changes) == text


def test_scopes_that_agree_are_said_once():
    rows = [(0.9, "marginal", "a"), (0.9, "joint", "a"), (0.95, "marginal", "a")]
    assert by_level([*rows, (0.95, "joint", "b")]) == [
        ("0.9 marginal and joint", "a"),
        ("0.95 marginal", "a"),
        ("0.95 joint", "b"),
    ]


def test_inspect_says_it_for_every_level_and_gives_the_measured_coverage(bundle):
    left_out = LeftOut(coverage=0.9125, standard_error=0.02)
    calibration = msgspec.structs.replace(
        bundle.calibration,
        thresholds=tuple(
            msgspec.structs.replace(entry, left_out=left_out)
            for entry in bundle.calibration.thresholds
        ),
    )
    lines = inspect_lines(calibration)
    for confidence in calibration.confidences("joint"):
        stated = [line for line in lines if f" at {confidence:g} marginal and joint: " in line]
        assert [line.split()[0] for line in stated] in (["proven"], ["unbounded"])
    text = " ".join(" ".join(lines).split())
    assert (
        "measured coverage of a recording left out, at 0.9: marginal 0.912 +- 0.020, joint 0.912 "
        "+- 0.020 "
    ) in text
    assert max(map(len, lines)) <= 80
