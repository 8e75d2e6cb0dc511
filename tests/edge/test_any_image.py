"""Whatever is given as an image: an estimate that says what is wrong, or a defined conversion."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays, scalar_dtypes

from cvo_edge import Odometer, Status

# Of any kind and shape; and such as cameras give, of any content.
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
    with Odometer.load(bundle_dir) as odometer:
        yield odometer


@settings(max_examples=300)
@given(
    image=st.none() | anything | images,
    stamp_ns=stamps,
)
def test_an_interval_is_finite_only_where_nothing_speaks_against_it(odometer, image, stamp_ns):
    estimate = odometer.step(image, stamp_ns)
    finite = np.isfinite([*estimate.lower, *estimate.upper])
    if estimate.status is Status.OK:
        assert estimate.pose is not None
        assert (estimate.lower <= estimate.upper).all()
    else:
        assert estimate.reasons
        assert not finite.any()
    assert (estimate.pose is None) == (estimate.status is Status.INVALID)


@settings(max_examples=60)
@given(image=st.none() | anything | images)
def test_the_next_good_frame_is_as_ever(odometer, clip_frame, image):
    before = odometer.step(clip_frame)
    odometer.step(image)
    after = odometer.step(clip_frame)
    assert after.pose.to_array().tolist() == before.pose.to_array().tolist()
    # The same image again is another matter: it is told by the model's own input.
    assert after.status in (Status.OK, Status.DEGRADED)


@pytest.fixture(scope="module")
def clip_frame(clip_dir):
    from cvo_edge import open_source

    return next(iter(open_source(str(clip_dir)))).image
