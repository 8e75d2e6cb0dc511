"""Volumes of unions of balls and ellipsoids against closed forms."""

import math

import numpy as np
import pytest

from cvo_edge.sets import Ellipsoids
from cvo_export.bundles.volume import ellipsoids_log_volume, union_log_volume

BALL = {2: math.pi, 3: 4.0 / 3.0 * math.pi, 6: math.pi**3 / 6.0}


@pytest.mark.parametrize("d", [2, 3, 6])
@pytest.mark.parametrize("radius", [0.3, 2.0])
def test_one_ball_and_any_number_of_the_same_are_exact(d, radius):
    one = np.full((1, d), 0.7)
    expected = math.log(BALL[d] * radius**d)
    assert union_log_volume(one, radius, 0) == pytest.approx(expected)
    assert union_log_volume(np.repeat(one, 50, axis=0), radius, 1) == pytest.approx(expected)


@pytest.mark.parametrize("d", [2, 3, 6])
def test_balls_that_are_apart_add_up(d):
    centres = np.zeros((4, d))
    centres[:, 0] = [0.0, 10.0, 20.0, 30.0]
    assert union_log_volume(centres, 1.0, 0) == pytest.approx(math.log(4 * BALL[d]))


def test_two_discs_that_overlap_are_their_lens_short():
    # Discs of radius 1 at a distance of 1 share an area of 2 acos(1/2) - sqrt(3)/2.
    centres = np.array([[0.0, 0.0], [1.0, 0.0]])
    expected = 2 * math.pi - (2 * math.acos(0.5) - math.sqrt(3) / 2)
    assert union_log_volume(centres, 1.0, 0, draws=200_000) == pytest.approx(
        math.log(expected), abs=0.01
    )


def test_a_union_grows_with_its_radius_and_is_nothing_without_one():
    centres = np.random.default_rng(0).standard_normal((40, 6))
    volumes = [union_log_volume(centres, radius, 0) for radius in (0.1, 0.5, 1.0, 2.0, 4.0)]
    assert volumes == sorted(volumes)
    assert union_log_volume(centres, 0.0, 0) == -math.inf
    assert union_log_volume(centres, math.inf, 0) == math.inf


def test_errors_of_frames_with_seeds_of_their_own_average_out():
    # A union of as many balls as a codebook has points; many draws give the reference volume.
    centres = np.random.default_rng(3).standard_normal((385, 6))
    exact = union_log_volume(centres, 1.5, 0, draws=100_000)
    found = [union_log_volume(centres, 1.5, seed) for seed in range(1, 41)]
    assert np.std(found) > 0.0
    assert np.mean(found) == pytest.approx(exact, abs=0.02)


def test_an_ellipsoid_has_the_volume_of_its_ball_times_the_determinant():
    generator = np.random.default_rng(1)
    scale = np.tril(generator.normal(0.0, 0.2, (6, 6))) + np.eye(6)
    region = Ellipsoids(generator.standard_normal((1, 6)), scale, 1.5)
    expected = BALL[6] * 1.5**6 * abs(np.linalg.det(scale))
    assert ellipsoids_log_volume(region, 0) == pytest.approx(math.log(expected))


def test_the_estimate_is_the_share_of_a_box_that_lies_inside():
    # Independent estimator: the share of uniform points in a box that lie in the region.
    generator = np.random.default_rng(2)
    scale = np.tril(generator.normal(0.0, 0.2, (6, 6))) + np.eye(6)
    region = Ellipsoids(generator.standard_normal((30, 6)), scale, 1.2)
    reach = 1.2 * np.linalg.norm(scale, axis=1)
    lowest, highest = region.centres.min(axis=0) - reach, region.centres.max(axis=0) + reach
    points = generator.uniform(lowest, highest, (20_000, 6))
    share = np.mean([region.contains(point) for point in points])
    expected = share * np.prod(highest - lowest)
    assert ellipsoids_log_volume(region, 0) == pytest.approx(math.log(expected), abs=0.15)
