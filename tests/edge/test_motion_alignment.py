"""Faults of a pair that are put in are found, and nothing else is."""

from dataclasses import replace

import numpy as np
import pytest

from cvo_edge import geometry
from cvo_edge.motion.alignment import align
from cvo_edge.motion.corrections import corrected, fit_of
from cvo_edge.programs.motion_report import fit_lines
from cvo_edge.programs.trajectories import fits
from cvo_edge.spread import Here
from cvo_edge.trajectories.interpolation import Track

from .simulated_drives import PERIOD_NS, chained, composed, drive, twist


@pytest.mark.parametrize("offset_ms", [0, 20, 50, -100])
def test_a_time_offset_is_found(offset_ms: int) -> None:
    pair = drive(1, 600, noise=0.3)
    late = replace(pair, stamps_ns=pair.stamps_ns + 1_000_000 * offset_ms)
    found = late.aligned()
    assert found is not None
    assert abs(1e3 * found.offset_s + offset_ms) < 4.0
    fit = fit_of(late, found)
    assert fit.effects["time"].worth == (offset_ms != 0)


def test_keyframes_at_odd_times_show_a_time_offset() -> None:
    pair = drive(1, 4000, noise=0.3)
    kept = np.cumsum(np.random.default_rng(0).integers(5, 25, 250))
    few = replace(pair, stamps_ns=pair.stamps_ns[kept] + 100_000_000, estimate=pair.estimate[kept])
    found = few.aligned()
    assert found is not None
    assert abs(found.offset_s + 0.1) < 0.02
    assert fit_of(few, found).effects["time"].worth


def test_a_turned_body_and_a_scale_are_found_and_corrected() -> None:
    pair = drive(2, 600, noise=0.3)
    turn = np.deg2rad([0.5, -1.5, 0.8])
    estimate = composed(pair.estimate, twist(np.concatenate([np.zeros(3), turn])))
    estimate[:, :3] *= 1.02
    off = replace(pair, estimate=estimate)
    found = off.aligned()
    assert found is not None
    # R leads from the estimate's frame to the truth's: back by the turn that was put in.
    np.testing.assert_allclose(np.rad2deg(found.rotation), np.rad2deg(turn), atol=0.1)
    assert abs(found.scale - 1.0 / 1.02) < 0.003
    fit = fit_of(off, found)
    assert fit.effects["frame"].worth
    assert fit.effects["scale"].worth
    again = corrected(off, found, ("time", "frame", "scale"))
    left = fit_of(again, align(again.stamps_ns, again.estimate, Track(pair.stamps_ns, again.truth)))
    assert not any(effect.worth for effect in left.effects.values())


def test_straight_motion_leaves_its_own_axis_undetermined() -> None:
    generator = np.random.default_rng(0)
    steps = np.zeros((600, 6))
    steps[:, 0] = 0.5 + 0.2 * np.sin(np.arange(600) / 40.0)
    truth = chained(twist(steps))
    noise = generator.normal(size=(601, 6)) * np.repeat([0.005, 0.0005], 3)
    estimate = composed(truth, twist(noise))
    stamps = PERIOD_NS * np.arange(601)
    found = align(stamps, estimate, Track(stamps, truth))
    assert found is not None
    assert len(found.undetermined) == 1
    assert abs(found.undetermined[0, 0]) > 0.99
    assert np.rad2deg(np.abs(found.determined_rotation)).max() < 0.2


def test_a_body_that_stands_gives_no_alignment() -> None:
    stamps = PERIOD_NS * np.arange(20)
    poses = np.tile([0.0, 0, 0, 0, 0, 0, 1], (20, 1))
    assert align(stamps, poses, Track(stamps, poses)) is None


def test_a_body_that_stands_for_most_of_a_drive_is_aligned() -> None:
    pair = drive(1, 600, noise=0.3)
    # It stands, without errors, for four fifths of the time.
    place = np.concatenate([np.arange(300), np.full(2400, 300), np.arange(300, 601)])
    stamps = PERIOD_NS * np.arange(len(place))
    late = stamps + 50_000_000
    found = align(late, pair.estimate[place], Track(stamps, pair.truth[place]))
    assert found is not None
    assert abs(found.offset_s + 0.05) < 0.004
    assert abs(found.scale - 1.0) < 0.01
    assert found.misfit.min() > 1e-3


def test_offsets_that_differ_are_told_by_their_range() -> None:
    pairs = [drive(seed, 300, noise=0.3) for seed in (1, 2)]
    shifts = zip(pairs, (50_000_000, -50_000_000), strict=True)
    late = [replace(pair, stamps_ns=pair.stamps_ns + shift) for pair, shift in shifts]
    (told,) = (line for line in fit_lines(fits(Here(late)), ()) if line.startswith("time: "))
    assert "-0.050 .. 0.050 s (up to 1.0 frames) in 2 of 2" in told


def test_corrections_do_not_touch_the_estimates_own_axes() -> None:
    pair = drive(3, 300)
    found = pair.aligned()
    assert found is not None
    same = corrected(pair, found, ("frame",))
    assert same.estimate is pair.estimate
    turned = geometry.quaternion_multiply(
        geometry.quaternion_conjugate(pair.truth[:, 3:]), same.truth[:, 3:]
    )
    np.testing.assert_allclose(
        geometry.quaternion_log(turned), np.tile(found.determined_rotation, (301, 1)), atol=1e-9
    )
