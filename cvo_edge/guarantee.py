"""What is proven about the coverage of each stored level, as one sentence.

docs/guarantee.md has the assumptions and the sources. The frames are those that pass the frame
checks; "missed" is the truth of one degree of freedom in the marginal scope, of any in the joint.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

from cvo_edge.bundle.format import CalibrationSpec, LeftOut, Threshold
from cvo_edge.conformal import recording_cap
from cvo_edge.heads import Head
from cvo_edge.heads.plausible import Draws
from cvo_edge.vocabulary import Scope

_SHARES = {0.25: "a quarter", 0.5: "half"}


def statement(source: CalibrationSpec, head: Head, entry: Threshold) -> str:
    """Return what is proven about the coverage of an entry's sets.

    An unbounded level gets, instead, the number of frames or recordings from which it is finite.
    With a crossed calibration, nothing is proven for the one network of the bundle; see
    docs/guarantee.md.
    """
    sides = [
        (level, q_hat)
        for level, q_hat in zip(
            head.levels(entry, source.joint), (entry.q_hat, entry.q_hat_upper), strict=False
        )
        if level is not None and q_hat is not None
    ]
    unbounded = [level for level, q_hat in sides if None in q_hat]
    draws = Draws.of(source)
    if unbounded and draws.given < (needed := draws.needed(max(unbounded))):
        return f"unbounded; finite from {needed} calibration {draws.unit}, has {draws.given}"
    levels = [level for level, _ in sides]
    if entry.scope == "joint":
        # One threshold on each frame's largest score, or six.
        levels = levels[:1] if source.joint == "max" else levels * 6
    claim = _claim(source, entry, levels)
    return f"{claim}; unbounded where {head.infinite_score}" if unbounded else claim


def by_level(statements: Iterable[tuple[float, Scope, str]]) -> list[tuple[str, str]]:
    """Confidence, scope and statement -> level and statement; scopes that agree are one level."""
    scopes: dict[tuple[float, str], list[Scope]] = {}
    for confidence, scope, text in statements:
        scopes.setdefault((confidence, text), []).append(scope)
    return [
        (f"{confidence:g} {' and '.join(found)}", text)
        for (confidence, text), found in scopes.items()
    ]


def left_out_text(scope: Scope, left_out: LeftOut) -> str:
    """Return a leave-one-recording-out coverage and its standard error as text."""
    return f"{scope} {left_out.coverage:.3f} +- {left_out.standard_error:.3f}"


def _claim(source: CalibrationSpec, entry: Threshold, levels: list[float]) -> str:
    """Return the statement about bounds that were calibrated one by one at these confidences."""
    if source.crossed is not None:
        return "nothing is proven: the network was trained on the recordings that calibrate it"
    alpha, kind = 1.0 - entry.confidence, source.split.kind
    cap = recording_cap(source.rule, source.cap)
    if cap is None and kind == "random":
        return (
            "of frames exchangeable with the calibration frames, on average at most "
            f"{_percent(alpha)} are missed"
        )
    if kind != "sequence":
        reason = f"in a {kind} split, recordings are shared among the roles"
        if cap is None:
            reason = "neighbouring frames depend on each other"
        return f"nothing is proven: {reason}"
    # The new recording is one of G + 1 and may be the worst: its misses beyond those that the rule
    # counts in advance (none if it counts frames) come on top, once for each bound.
    draws = source.n_sequences + 1
    if cap is None:
        share = sum(1.0 - level + level / draws for level in levels)
        if share >= 1.0:
            return f"nothing is proven over new recordings, from {source.n_sequences}"
        return (
            f"over new recordings of equal length, on average at most {_percent(share)} of frames "
            "are missed"
        )
    claim = f"over new recordings, on average at most {_percent(alpha)} of frames are missed"
    if cap == 1.0:
        return claim
    most = _SHARES.get(cap, _percent(cap))
    plain = min(1.0, alpha + len(levels) * (1.0 - cap) / draws)
    return (
        f"{claim}, where a recording that misses more than {most} counts as {most} "
        f"(in full: {_percent(plain)})"
    )


def _percent(share: float) -> str:
    """Return a share in percent, rounded up to a tenth, as a bound has to be."""
    return f"{math.ceil(1000.0 * share - 1e-6) / 10:g} %"
