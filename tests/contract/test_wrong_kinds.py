"""Every kind of wrong frame changes a stream as it says, the same way each time, and only that."""

import sys
from collections import Counter
from pathlib import Path

import cv2
import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "bench"))

from wrong_kinds import HARMLESS, KINDS, WRONG, frame

from cvo_export.datasets import open_dataset


@pytest.fixture(scope="module")
def images():
    room = open_dataset("synthetic:room,flights=1,frames=45,size=96x72")
    found = [room.read_image(number) for number in range(45)]
    for image in found:
        image.setflags(write=False)
    return found


def test_there_are_at_least_sixty_kinds_with_names_of_their_own():
    assert len(WRONG) >= 60
    assert len(KINDS) == len(WRONG) + len(HARMLESS)
    assert min(Counter(kind.family for kind in WRONG).values()) >= 7
    assert sum(kind.fitted for kind in WRONG) < 10


@pytest.mark.parametrize("kind", KINDS.values(), ids=KINDS)
def test_a_kind_keeps_type_and_size_repeats_itself_and_starts_where_it_says(kind, images):
    for number in {0, kind.start, kind.start + 3}:
        found = frame(kind, images, number)
        assert found.dtype == np.uint8
        assert found.shape == images[number].shape
        np.testing.assert_array_equal(found, frame(kind, images, number))
        if number < kind.start:
            assert found is images[number]


@pytest.mark.parametrize("kind", HARMLESS, ids=lambda kind: kind.name)
def test_a_harmless_change_is_small(kind, images):
    # Of groups of four by four pixels: fine texture is what coding and scaling lose.
    before, after = (
        cv2.resize(image, (24, 18), interpolation=cv2.INTER_AREA).astype(float)
        for image in (images[5], frame(kind, images, 5))
    )
    assert np.sqrt(np.mean((after - before) ** 2)) < 16


@pytest.mark.parametrize("kind", WRONG, ids=lambda kind: kind.name)
def test_a_wrong_frame_differs_from_the_right_one(kind, images):
    number = kind.start + 3
    difference = frame(kind, images, number).astype(float) - images[number]
    assert np.sqrt(np.mean(difference**2)) > 3


def test_a_ring_shows_its_images_in_turn(images):
    kind = KINDS["ring of 9 buffers"]
    shown = [frame(kind, images, number) for number in range(10, 28)]
    for number, image in enumerate(shown):
        np.testing.assert_array_equal(image, images[1 + number % 9])
