"""A difficulty is fitted to val frames and noisy copies of them, and kept only if it helps."""

import dataclasses

import msgspec
import numpy as np
import pytest

from cvo_edge import Odometer
from cvo_edge.bundle.format import DifficultySpec, SplitSpec
from cvo_edge.bundle.reading import read_calibration
from cvo_edge.engine.loading import Bundle, read_bundle
from cvo_edge.heads import Candidate
from cvo_edge.heads.cqr import CqrParameters
from cvo_export.bundles.choice import with_difficulty
from cvo_export.bundles.difficulty import degraded
from cvo_export.bundles.draft import Draft
from cvo_export.bundles.observed import Observed
from cvo_export.bundles.refused import Refused
from cvo_export.data.noise import KINDS
from cvo_export.datasets import PoseDataset, open_dataset

from .conftest import DATASET

SLOPES = np.array([0.6, 0.0, 0.2, 0.0])


def seen(generator, count, novelty, slopes=SLOPES):
    """Frames of this log novelty, whose errors grow with it."""
    log_novelty = novelty + 0.3 * generator.standard_normal((count, 4))
    spread = np.exp(log_novelty @ slopes)[:, np.newaxis]
    point = generator.normal(0.0, 1.0, (count, 6))
    poses = np.zeros((count, 7))
    return Observed(
        indices=np.arange(count),
        outputs={
            "pose": poses.astype(np.float32),
            "novelty": np.exp(log_novelty).astype(np.float32),
            "degradation": np.zeros((count, 1), np.float32),
        },
        point=point,
        truth=point + 0.02 * spread * generator.standard_t(5, (count, 6)),
        pose=poses,
        true_pose=poses,
        sequence=np.zeros(count, np.int64),
        coloured=np.ones(count, bool),
        size=(64, 48),
        refused=Refused(),
        judged=None,
    )


@pytest.fixture(scope="module")
def draft(tiny_bundle):
    calibration = read_calibration(tiny_bundle)
    pose = tuple(spec for spec in calibration.model.outputs if spec.name not in ("lower", "upper"))
    made = Draft.of(calibration)
    model = msgspec.structs.replace(made.model, outputs=pose)
    return dataclasses.replace(made, method="cqr", model=model)


RESIDUAL = Candidate("residual", CqrParameters((0.01,) * 6, "symmetric"))


def test_the_fit_finds_the_scale_of_the_errors_and_covers_noisy_frames(draft):
    generator = np.random.default_rng(3)
    clean, noisy = seen(generator, 300, 0.0), seen(generator, 600, 1.5)
    found = with_difficulty(draft, RESIDUAL, clean, noisy)
    plain, scaled = draft.head(RESIDUAL), found.head(RESIDUAL)
    u = scaled.difficulty.factors(noisy.outputs)
    expected = np.log(noisy.outputs["novelty"].astype(float)) @ SLOPES
    assert np.median(scaled.difficulty.factors(clean.outputs)) == pytest.approx(1.0)
    slope = np.polyfit(expected, np.log(u), 1)[0]
    # Steeper by a fifth, on purpose.
    assert 1.0 < slope < 1.4
    covered = []
    for head in (plain, scaled):
        at = np.quantile(head.scores(clean.outputs, clean.point, clean.truth), 0.9, axis=0)
        fresh = seen(generator, 300, 1.5)
        covered.append((head.scores(fresh.outputs, fresh.point, fresh.truth) <= at).mean())
    assert covered[0] < 0.6
    assert covered[1] > 0.88


def test_a_difficulty_that_tells_nothing_or_costs_too_much_is_left_out(draft):
    generator = np.random.default_rng(4)
    clean = seen(generator, 120, 0.0, 0.0 * SLOPES)
    # Novelty grows, errors do not.
    noisy = seen(generator, 240, 1.5, 0.0 * SLOPES)
    assert with_difficulty(draft, RESIDUAL, clean, noisy).difficulty is None


def test_copies_have_every_noise_and_never_come_from_other_roles():
    generator = np.random.default_rng(5)
    images = generator.integers(60, 180, (30, 24, 32, 3)).astype(np.uint8)
    poses = generator.normal(size=(30, 7))
    names = tuple(map(str, range(30)))
    dataset = PoseDataset("noise", poses, np.zeros(30, int), ("one",), names, images.__getitem__)
    rows, read = np.arange(3, 30, 3), []

    def see(copies, indices):
        assert len(copies) == len(copies.frame_names) == len(indices)
        for index in indices.tolist():
            first, again = copies.read_image(index), copies.read_image(index)
            np.testing.assert_array_equal(first, again)
            read.append((first, copies.poses[index]))
        whole = seen(generator, len(indices), 0.0)
        # One is left out by the checks of the image.
        return whole.where(np.arange(len(indices)) != 4)

    split = SplitSpec(purpose="training", kind="random", seed=1, sha256="0" * 64)
    found = degraded(see, dataset, split, rows)
    assert len(found.indices) == len(read) - 1
    assert set(found.indices) <= set(rows)
    assert len(read) % len(KINDS) == 0
    assert not any((image == images).all(axis=(1, 2, 3)).any() for image, _ in read)
    for row, (_, pose) in zip(found.indices[:4], read[:4], strict=True):
        np.testing.assert_array_equal(pose, poses[row])


def test_a_stream_with_a_difficulty_scales_its_sets_and_takes_labels(tiny_bundle):
    given = read_bundle(tiny_bundle)
    spec = DifficultySpec(weights=(0.2, 0.1, 0.0, 0.0), bias=0.3, lowest=-0.7, highest=3.5)
    made = msgspec.structs.replace(given.calibration, difficulty=spec)
    plain = msgspec.structs.replace(given.calibration, difficulty=None)
    dataset = open_dataset(DATASET)
    image = dataset.read_image(0)
    with (
        Odometer(Bundle.of(made, given.model), threads=1, adapt=True) as scaled,
        Odometer(Bundle.of(plain, given.model), threads=1) as bare,
    ):
        observation = bare.observe(image, 0)
        u = scaled.head.difficulty.factors(observation.outputs)[0]
        assert u != 1.0
        np.testing.assert_allclose(
            scaled.conformal_set(observation).width(),
            u * bare.conformal_set(observation).width(),
        )
        estimate = scaled.step(image)
        update = scaled.update(estimate.seq, dataset.poses[0])
        assert estimate.bounded
        assert update.covered is not None
