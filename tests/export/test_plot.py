"""What a picture says of degrees of freedom that stand still, and of unbounded sets."""

from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

from cvo_edge.bundle.reading import read_calibration
from cvo_edge.estimate import PoseInterval
from cvo_edge.pose import Chart, Pose
from cvo_edge.record import Reason, Status
from cvo_edge.sets import ConformalSet, unbounded_set
from cvo_export.plot import Track, draw_dof, draw_from_above

pytest.importorskip("matplotlib")

BUNDLE = Path(__file__).resolve().parents[2] / "calibration_artifacts/synthetic-room-cqr"
FRAMES, FLOOR, TOO_FEW = 8, 1e-3, "unbounded; finite from 4 calibration recordings, has 3"


def _track(half_width: float, unbounded: int, proven: str) -> Track:
    """A camera that never moves; the first sets are ``unbounded``."""
    known = read_calibration(BUNDLE)
    pose = replace(known.pose, still=("tx", "tz", "rx"), standard_deviation=(FLOOR,) * 6)
    chart = Chart("tangent_predicted")
    place = np.array([0.0, -0.4, 5e6])
    truth = np.concatenate([place, np.zeros(3)])
    estimates = []
    for row in range(FRAMES):
        point = np.concatenate([place + 1e-6 * (row % 3), np.zeros(3)])
        doubted = row < unbounded and proven != TOO_FEW
        found = ConformalSet(point - half_width, point + half_width)
        estimates.append(
            PoseInterval(
                seq=row,
                stamp_ns=None,
                source="",
                status=Status.DEGRADED if doubted else Status.OK,
                reasons=(Reason.IMAGE_UNFAMILIAR,) if doubted else (),
                pose=Pose(point[:3], np.array([0.0, 0.0, 0.0, 1.0])),
                conformal_set=unbounded_set() if row < unbounded else found,
                confidence=0.9,
                scope="marginal",
                chart=chart,
            )
        )
    rows = list(range(FRAMES))
    parts = np.zeros(FRAMES, np.int64)
    calibration = replace(known, pose=pose)
    return Track(calibration, chart, estimates, np.tile(truth, (FRAMES, 1)), rows, parts, proven)


@pytest.mark.parametrize(
    ("unbounded", "proven", "said"),
    [
        (0, "nothing is proven", ""),
        (3, "nothing is proven", "unbounded in 3 of 8 frames; image_unfamiliar"),
        (FRAMES, TOO_FEW, TOO_FEW),
    ],
)
@pytest.mark.parametrize("half_width", [1e-5, 2 * FLOOR])
def test_titles_say_what_stands_still_and_why_sets_are_unbounded(
    unbounded, proven, said, half_width
):
    from matplotlib.figure import Figure

    drawn = _track(half_width, unbounded, proven)
    panels = Figure().subplots(7, 1)
    for dof in range(6):
        draw_dof(panels[dof], drawn, dof)
        first, _, rest = panels[dof].get_title().partition("\n")
        still = dof in (0, 2, 3)
        assert first.startswith("stands still") == still
        assert (rest if still else first) == said
        # Unbounded sets are hatched, so that no block hides the panel.
        bars = panels[dof].patches
        assert [bar.get_hatch() is not None for bar in bars].count(True) == unbounded
        assert len(bars) == FRAMES
        if still:
            low, high = panels[dof].get_ylim()
            unit = 1.0 if dof < 3 else np.rad2deg(1.0)
            least = max(4 * FLOOR, 2.2 * half_width * (unbounded < FRAMES))
            assert high - low >= 0.999 * unit * least
    draw_from_above(panels[6], drawn)
    first, _, rest = panels[6].get_title().partition("\n")
    assert rest == said
    assert ("without sets" in first) == (unbounded == FRAMES)
    low, high = panels[6].get_xlim()
    assert high - low >= 0.999 * 4 * FLOOR
