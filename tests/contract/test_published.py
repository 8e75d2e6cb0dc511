"""The demonstration bundles yield the numbers they were published with.

``data/published.json`` holds their thresholds and their estimates on the first frames of the
demonstration clip, computed by the code that published them.
"""

import json
from pathlib import Path

import numpy as np
import pytest

from cvo_edge import Odometer, open_source, read_bundle

PUBLISHED = json.loads((Path(__file__).parent / "data/published.json").read_bytes())
# Kernels of other processors round differently; a wrong rule would be off by far more.
TOLERANCE = 1e-4


@pytest.mark.parametrize("method", PUBLISHED)
def test_thresholds_are_read_to_the_last_digit(artifacts_dir, method):
    found = read_bundle(artifacts_dir / f"synthetic-room-{method}").calibration.thresholds
    expected = PUBLISHED[method]["thresholds"]
    assert len(found) == len(expected) == 10
    for entry, (confidence, scope, q_hat, q_hat_upper) in zip(found, expected, strict=True):
        assert (entry.confidence, entry.scope) == (confidence, scope)
        assert list(entry.q_hat) == q_hat
        assert (None if entry.q_hat_upper is None else list(entry.q_hat_upper)) == q_hat_upper


@pytest.mark.parametrize("scope", ["marginal", "joint"])
@pytest.mark.parametrize("method", PUBLISHED)
def test_estimates_are_those_of_the_code_that_published_them(
    artifacts_dir, clip_dir, method, scope
):
    expected = PUBLISHED[method]["estimates"][scope]
    frames = iter(open_source(clip_dir))
    with Odometer.load(artifacts_dir / f"synthetic-room-{method}", scope=scope) as odometer:
        for before in expected:
            estimate = odometer.step(next(frames).image)
            np.testing.assert_allclose(estimate.pose.to_array(), before["pose"], atol=TOLERANCE)
            np.testing.assert_allclose(estimate.lower, before["lower"], atol=TOLERANCE)
            np.testing.assert_allclose(estimate.upper, before["upper"], atol=TOLERANCE)
            if before["bands"] is None:
                assert estimate.bands is None
            else:
                for found, row in zip(estimate.bands, before["bands"], strict=True):
                    np.testing.assert_allclose(found, row, atol=TOLERANCE)
