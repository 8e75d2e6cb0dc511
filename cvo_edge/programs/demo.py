"""The demonstration: run a bundle on the packaged clip, compare with ground truth, and draw it."""

from __future__ import annotations

from pathlib import Path
from textwrap import fill
from typing import Any

import msgspec

from cvo_edge.errors import UsageError
from cvo_edge.estimate import PoseInterval
from cvo_edge.ground_truth import open_ground_truth
from cvo_edge.input.sources import open_source
from cvo_edge.odometer import Odometer
from cvo_edge.output.picture import draw_run, write_png
from cvo_edge.output.sinks import Sink
from cvo_edge.programs.run import RunSummary, run
from cvo_edge.programs.verify import verify_bundle
from cvo_edge.vocabulary import Scope

PACKAGED = Path(__file__).resolve().parent.parent / "demonstration"
BUNDLE, CLIP, EXPECTED = (PACKAGED / n for n in ("bundle", "clip", "expected_coverage.json"))

_CONFIDENCE = 0.9
_SCOPE: Scope = "marginal"
_ROWS = 4


def demo(bundle: Path, picture: Path) -> None:
    """Verify a bundle, run it on the packaged clip, print the results and draw them as PNG.

    Results go to standard output; the last line is the path of the picture.

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
        summary = RunSummary(odometer.chart.dof, _CONFIDENCE, _SCOPE, with_truth=True)

        def write(estimate: PoseInterval) -> None:
            if len(estimates) < _ROWS:
                table.write(estimate)
            estimates.append(estimate)

        run(odometer, open_source(str(CLIP)), write, summary=summary, truth=truth)
    expected = expected_coverage(digest)
    print("...", *summary.lines(), sep="\n")
    if expected:
        print(fill(expected, 80, initial_indent="expected    ", subsequent_indent=" " * 12))
    drawn = draw_run(
        estimates,
        [truth.pose_of(estimate) for estimate in estimates],
        f"{name}: each interval holds the truth with probability {_CONFIDENCE:g}",
        [_found(summary), f"Expected: {expected}" if expected else ""],
    )
    write_png(picture, drawn)
    print(picture)


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
