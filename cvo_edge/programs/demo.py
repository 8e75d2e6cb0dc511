"""The demonstration: run a bundle on the packaged clip, compare with ground truth, and draw it.

A bundle with an alarm sees the clip twice, the second time with a hand before the lens.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from textwrap import fill
from typing import Any

import msgspec
import numpy as np

from cvo_edge.errors import UsageError
from cvo_edge.estimate import PoseInterval
from cvo_edge.ground_truth import GroundTruth, open_ground_truth
from cvo_edge.input.frame import Frame
from cvo_edge.input.sources import open_source
from cvo_edge.odometer import Odometer
from cvo_edge.output.drawing import write_png
from cvo_edge.output.picture import Span, draw_run
from cvo_edge.output.sinks import Sink
from cvo_edge.programs.hand import HAND, covered
from cvo_edge.programs.run import RunSummary, run
from cvo_edge.programs.verify import verify_bundle
from cvo_edge.vocabulary import Scope

PACKAGED = Path(__file__).resolve().parent.parent / "demonstration"
BUNDLE, CLIP, EXPECTED = (PACKAGED / n for n in ("bundle", "clip", "expected_coverage.json"))

_CONFIDENCE = 0.9
_SCOPE: Scope = "marginal"
_ROWS = 4
_FRAMES = f"{HAND.start} to {HAND.stop - 1}"
_HAND = f"a hand before the lens in frames {_FRAMES}"


def demo(bundle: Path, picture: Path) -> None:
    """Verify a bundle, run it on the packaged clip, print the results and draw them as PNG.

    Results go to standard output; the last line is the path of the picture, which shows the run
    with the hand if there is one.

    Raises
    ------
    UsageError
        The picture's name does not end in ``.png``, or no frame of the clip has an interval (the
        bundle was trained on another scene).
    SinkError
        The picture cannot be written.
    CvoError
        ``verify_bundle`` refuses the bundle.
    """
    if picture.suffix.lower() != ".png":
        raise UsageError(f"picture: expected a name that ends in .png, found {picture}")
    print(verify_bundle(bundle).line(), flush=True)
    truth = open_ground_truth(CLIP)
    estimates: list[PoseInterval] = []
    # The model cache is not used, so that the picture is the only file that the demo creates.
    with (
        Odometer.load(bundle, confidence=_CONFIDENCE, scope=_SCOPE) as odometer,
        Sink("-", "table") as table,
    ):
        name, digest = odometer.calibration.name, odometer.calibration.digest
        summary = RunSummary(odometer.chart.dof, _CONFIDENCE, _SCOPE, truth=truth)

        def write(estimate: PoseInterval) -> None:
            if len(estimates) < _ROWS:
                table.write(estimate)
            estimates.append(estimate)

        run(odometer, open_source(str(CLIP)), write, summary=summary)
        expected = expected_coverage(digest)
        print("...", *summary.lines(), sep="\n")
        if expected:
            print(_indented("expected", expected))
        if not summary.bounded:
            raise UsageError(
                f"demo: expected a bundle that was trained on the clip's scene (synthetic-room-*), "
                f"found {name}, which gives no frame an interval"
            )
        if summary.in_alarm:
            print(_indented("alarm", _false_alarm(odometer.drift.false_alarms)))
        notes = [_found(summary), f"Expected: {expected}" if expected else ""]
        span = None
        if odometer.calibration.alarm is None:
            print(_indented("hand", "not shown: it takes an alarm, and this bundle has none"))
        else:
            frames = list(covered(open_source(str(CLIP))))
            estimates, told = _with_hand(odometer, frames, estimates, truth, table)
            notes = [f"Without the hand: {note}" for note in notes[:1] if note] + notes[1:]
            notes = [*filter(None, notes), f"With {_HAND}: {told}."]
            middle = HAND[len(HAND) // 2]
            span = Span(HAND.start, HAND.stop - 1, "hand", middle, np.asarray(frames[middle].image))
    drawn = draw_run(
        estimates,
        [truth.pose_of(estimate) for estimate in estimates],
        f"{name}: each interval holds the truth with probability {_CONFIDENCE:g}",
        notes,
        span,
    )
    write_png(picture, drawn)
    print(picture)


def _false_alarm(bound: float | None) -> str:
    """Return in words what an alarm on the clip, whose images are right, is."""
    text = "nothing is wrong with these images: it is a false one"
    return text if bound is None else f"{text}, as in at most {bound:.0%} of new recordings"


def _with_hand(
    odometer: Odometer,
    frames: Sequence[Frame],
    plain: Sequence[PoseInterval],
    truth: GroundTruth,
    table: Sink,
) -> tuple[list[PoseInterval], str]:
    """Run the clip with a hand, and print what happens; ``plain`` are the estimates without it.

    Returns the estimates, and what happened in words.
    """
    print(_indented("hand", f"the clip again, with {_HAND}:"), flush=True)
    estimates = list(odometer.stream(frames))
    for number in _turns(estimates):
        table.write(estimates[number])
    told = what_happened(estimates)
    worst, usual = (_worst_cm(each, truth) for each in (estimates, plain))
    errors = f"with it, poses are up to {worst:.1f} cm off, without it up to {usual:.1f} cm"
    print(_indented("", f"{errors}; {told}"))
    return estimates, told


def what_happened(estimates: Sequence[PoseInterval]) -> str:
    """Return in words which frames of a clip with a hand have no interval, and why.

    ``estimates`` are those of the whole clip, in order.
    """
    lost = [number for number in HAND if not estimates[number].bounded]
    if not lost:
        return "all these frames have an interval, the hand is not noticed"
    reasons = {reason: None for number in lost for reason in estimates[number].reasons}
    text = f"no interval in {len(lost)} of {len(HAND)} frames ({', '.join(reasons)})"
    back = next((n for n in range(HAND.stop, len(estimates)) if estimates[n].bounded), None)
    if back is None:
        return f"{text}, nor in any later one"
    return f"{text}, intervals are back in frame {back}"


def _worst_cm(estimates: Sequence[PoseInterval], truth: GroundTruth) -> float:
    """Return the largest position error in the frames of the hand, in centimetres."""
    errors = [0.0]
    for number in HAND:
        pose, true = estimates[number].pose, truth.pose_of(estimates[number])
        if pose is not None and true is not None:
            errors.append(100 * float(np.linalg.norm(pose.t_m - true[:3])))
    return max(errors)


def _turns(estimates: Sequence[PoseInterval]) -> list[int]:
    """Return the frames on both sides of the first loss of the interval and of its return."""
    bounded = [estimate.bounded for estimate in estimates]
    changes = [n for n in range(HAND.start, len(bounded)) if bounded[n] != bounded[n - 1]]
    ends = changes[:1] + [n for n in changes if n >= HAND.stop][:1]
    return sorted({number for end in ends for number in (end - 1, end)})


def _indented(name: str, text: str) -> str:
    """Return a line of the summary, wrapped."""
    return fill(text, 80, initial_indent=f"{name:<12}", subsequent_indent=" " * 12)


def expected_coverage(digest: str) -> str | None:
    """Return the coverage to expect of one recording of the scene, measured over many.

    ``digest`` is that of the bundle's calibration. Returns None if the bundle was not measured by
    ``bench/expected_coverage.py``: theory does not give the coverage of a single recording.
    """
    report: dict[str, Any] = msgspec.json.decode(EXPECTED.read_bytes())
    found = report["bundles"].get(digest)
    if found is None:
        return None
    each, six = (
        f"{figures['q05']:.2f} to {figures['q95']:.2f}"
        for figures in (found["one_dof"], found["all_six"])
    )
    return (
        f"{each} per DoF (mean {found['one_dof']['mean']:.2f}), {six} for all six (mean "
        f"{found['all_six']['mean']:.2f}) in 9 of 10 new flights ({report['flights']} measured); "
        "errors of neighbouring frames are correlated"
    )


def _found(summary: RunSummary) -> str:
    """Return a sentence with the coverage on the clip."""
    if not summary.compared:
        return ""
    covered = float(summary.covered.mean()) / summary.compared
    jointly = summary.covered_jointly / summary.compared
    return (
        f"A flight that is in no training or calibration data, {summary.compared} frames. "
        f"Coverage: {covered:.2f} on average over the six DoF, {jointly:.2f} for all six at once."
    )
