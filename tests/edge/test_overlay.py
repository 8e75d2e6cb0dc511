"""What an estimate draws on its image: bars for a frame that is vouched for, and for no other."""

from dataclasses import replace

import numpy as np
import pytest

from cvo_edge import geometry
from cvo_edge.errors import UsageError
from cvo_edge.estimate import PoseInterval
from cvo_edge.pose import Chart, Pose
from cvo_edge.record import Reason, Status
from cvo_edge.sets import ConformalSet, unbounded_set

POSE = Pose(np.array([1.0, 2.0, 3.0]), geometry.quaternion_exp([0.3, -0.2, 0.1]))
HALF = np.array([0.02, 0.01, 0.03, 0.008, 0.006, 0.01])


def frame(status=Status.OK, found=None, rotation="tangent_predicted"):
    chart = Chart(rotation)
    point = chart.point(POSE.to_array())
    pose = None if status is Status.INVALID else POSE
    found = found or ConformalSet(point - HALF, point + HALF)
    return PoseInterval(*(7, None, "f.jpg", status, (), pose, found, 0.9, "joint", chart))


OK = frame()
HALF_OPEN = frame(found=replace(OK.conformal_set, upper=np.array([np.inf, *OK.upper[1:]])))
DEGRADED = replace(
    frame(Status.DEGRADED, unbounded_set()), reasons=(Reason.FRAME_STALE, Reason.IMAGE_GREY)
)
INVALID = replace(frame(Status.INVALID, unbounded_set()), reasons=tuple(Reason))


def green(drawn):
    blue, green, red = drawn.astype(int).transpose(2, 0, 1)
    return np.count_nonzero((green > blue + 60) & (green > red + 60))


@pytest.mark.parametrize("size", [(480, 640), (120, 160), (160, 120), (16, 16)])
@pytest.mark.parametrize("channels", [(), (1,), (3,), (4,)])
def test_only_a_frame_that_is_vouched_for_has_colour(size, channels):
    image = np.full((*size, *channels), 200, np.uint8)
    kept = image.copy()
    for estimate in (OK, HALF_OPEN, DEGRADED, INVALID):
        drawn = estimate.draw(image)
        assert drawn.shape == (*size, 3)
        assert drawn.dtype == np.uint8
        assert (green(drawn) > 0) == estimate.vouched == (estimate is OK)
        brightest = drawn[2 * size[0] // 3, size[1] // 2 - 4].max()
        assert (brightest <= 110) or estimate.vouched
    np.testing.assert_array_equal(image, kept)


def bars(estimate):
    """Green pixels of the bottom rows, where no text is green."""
    return green(estimate.draw(np.full((480, 640, 3), 200, np.uint8))[-90:-10, 30:-10])


def test_a_set_with_a_gap_is_drawn_with_it():
    point = OK.chart.point(POSE.to_array())
    rows = tuple(
        ((x - h, x - 0.5 * h), (x + 0.5 * h, x + h)) for x, h in zip(point, HALF, strict=True)
    )
    split = frame(found=replace(OK.conformal_set, bands=rows))
    assert 0.4 * bars(OK) < bars(split) < 0.6 * bars(OK)
    # A point is hidden by the mark of the pose, in any chart.
    euler = Chart("euler_zyx").point(POSE.to_array())
    assert bars(frame(found=ConformalSet(euler, euler), rotation="euler_zyx")) == 0


def test_16_bits_are_the_upper_ones_of_8():
    image = np.random.default_rng(0).integers(0, 256, (120, 160, 3), np.uint8)
    np.testing.assert_array_equal(OK.draw(image.astype(np.uint16) << 8), OK.draw(image))


@pytest.mark.parametrize(
    "image",
    [
        None,
        "f.jpg",
        np.zeros((9, 9), np.uint8),
        np.zeros((99, 99, 2), np.uint8),
        np.zeros((99, 99)),
    ],
    ids=["none", "a name", "tiny", "two channels", "floats"],
)
def test_anything_but_an_image_is_refused(image):
    with pytest.raises(UsageError, match="image: expected a grey or BGR image"):
        OK.draw(image)
