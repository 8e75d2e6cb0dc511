"""Any image array yields a defined conversion, or an estimate that names the problem."""

from collections import Counter

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays, scalar_dtypes

from cvo_edge import Frame, Odometer, Status, open_source

# Arrays of any type and shape, and typical camera images.
anything = arrays(scalar_dtypes(), array_shapes(min_dims=0, max_dims=4, max_side=24))
images = st.one_of(
    arrays(
        st.sampled_from([np.uint8, np.uint16]),
        st.tuples(st.integers(14, 40), st.integers(14, 40), st.sampled_from([1, 2, 3, 4, 5])),
    ),
    arrays(
        st.sampled_from([np.float32, np.int32, np.bool_]),
        st.tuples(st.integers(16, 40), st.integers(16, 40), st.just(3)),
    ),
)
stamps = st.none() | st.integers(-(2**63), 2**63 - 1)


@pytest.fixture(scope="module")
def odometer(bundle_dir):
    with Odometer.load(bundle_dir, threads=1) as odometer:
        yield odometer


@pytest.fixture(scope="module")
def scene(clip_dir):
    return [frame.image for frame in open_source(str(clip_dir))][:8]


def one_of_a_scene(data, scene):
    """Convert a good image: grey, with alpha, 16-bit, cropped, rotated or overexposed."""
    image = data.draw(st.sampled_from(scene))
    return data.draw(
        st.sampled_from(
            [
                image,
                image[:, :, :1],
                image[:, :, 0],
                np.dstack([image, image[:, :, 0]]),
                image.astype(np.uint16) * 257,
                image[20:-20, 20:-20],
                image[::-1],
                np.clip(image * 6.0, 0, 255).astype(np.uint8),
            ]
        )
    )


def test_an_interval_is_finite_only_without_a_reason_against_it(odometer, scene):
    seen = Counter()

    # Hypothesis does not draw evenly: of 600 with two kinds of five from a scene, 46 were ok once.
    @settings(max_examples=600)
    @given(data=st.data(), stamp_ns=stamps)
    def law(data, stamp_ns):
        kind = data.draw(st.sampled_from(["none", "anything", "image", *("scene",) * 4]))
        image = {
            "none": lambda: None,
            "anything": lambda: data.draw(anything),
            "image": lambda: data.draw(images),
            "scene": lambda: one_of_a_scene(data, scene),
        }[kind]()
        # A new stream has no earlier frame to compare with.
        (estimate,) = odometer.stream([Frame(image, stamp_ns, "", 0.0)])
        seen[estimate.status] += 1
        finite = np.isfinite([*estimate.lower, *estimate.upper])
        assert (estimate.status is Status.OK) == (not estimate.reasons)
        assert finite.all() == (estimate.status is Status.OK)
        assert finite.any() == finite.all()
        assert (estimate.pose is None) == (estimate.status is Status.INVALID)

    law()
    # Degraded estimates are rare: distorted images seldom yield a plausible pose.
    assert min(seen[Status.OK], seen[Status.INVALID]) > 50, seen


@settings(max_examples=60)
@given(image=st.none() | anything | images)
def test_a_bad_frame_does_not_change_the_next_pose(odometer, scene, image):
    (before,) = odometer.stream([scene[0]])
    _, after = odometer.stream([image, scene[0]])
    assert after.pose.to_array().tolist() == before.pose.to_array().tolist()
