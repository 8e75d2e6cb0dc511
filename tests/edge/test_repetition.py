"""Pictures that came before are found; cameras at rest with fresh noise are not accused."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cvo_edge import Odometer, Reason, open_source
from cvo_edge.input.preprocess import model_input
from cvo_edge.input.repetition import FRAMES, Digest, Repetition, _block_hashes
from cvo_edge.programs.run import RunSummary

HEIGHT, WIDTH = 192, 256
REPEATED, STILL = (Reason.FRAME_REPEATED,), (Reason.PICTURE_STILL,)


def panorama(seed=0):
    """A wide picture with texture everywhere, int16."""
    noise = np.random.default_rng(seed).normal(size=(HEIGHT, 6 * WIDTH, 3)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 9)
    return np.clip(128 + 40 * smooth / smooth.std(), 20, 235).astype(np.int16)


WIDE = panorama()
NOISE = np.random.default_rng(1)
UNIT = NOISE.standard_normal((HEIGHT + 64, WIDTH + 64, 3), np.float32)


def at(x, deviation=2.0):
    """The model's input at ``x`` pixels along the panorama, with fresh noise."""
    window = WIDE[:, round(x) : round(x) + WIDTH]
    row, column = NOISE.integers(0, 64, 2)
    noise = UNIT[row : row + HEIGHT, column : column + WIDTH]
    return np.clip(np.rint(window + deviation * noise), 0, 255).astype(np.uint8)[np.newaxis]


def doubts(tensors, **told):
    checks = Repetition()
    return [checks.doubts(Digest.of(tensor), **told) for tensor in tensors]


@pytest.mark.parametrize("length", [1, 2, 9, FRAMES])
def test_a_ring_of_buffers_is_found_from_its_first_repetition_on(length):
    ring = [at(3 * k) for k in range(length)]
    found = doubts([*ring, *ring[:9], at(1000)])
    again = min(9, length)
    assert found == [()] * length + [REPEATED] * again + [()]


@pytest.mark.parametrize(("blocks", "found"), [(2, ()), (3, REPEATED), (48, REPEATED)])
def test_equal_blocks_are_a_copy_if_they_are_a_twentieth_of_the_picture(blocks, found):
    before, now = at(0), at(40)
    for block in range(blocks):
        rows = slice(32 * (block // 8), 32 * (block // 8) + 32)
        columns = slice(32 * (block % 8), 32 * (block % 8) + 32)
        now[0, rows, columns] = before[0, rows, columns]
    assert doubts([before, now])[-1] == found


def test_a_part_that_freezes_is_found_beside_one_that_moves():
    frames = [at(5 * k) for k in range(12)]
    for frame in frames[6:]:
        frame[0, 160:] = frames[5][0, 160:]
    assert doubts(frames) == [()] * 6 + [REPEATED] * 6


@pytest.mark.parametrize("value", [0, 100, 255])
def test_blocks_without_texture_prove_nothing(value):
    frames = [at(5 * k) for k in range(6)]
    for frame in frames:
        frame[0, 32:] = value
    assert doubts(frames) == [()] * 6
    assert doubts([np.full((1, HEIGHT, WIDTH, 3), value, np.uint8)] * 6) == [()] * 6


def test_clipped_blocks_with_an_edge_prove_nothing():
    frames = [at(5 * k) for k in range(6)]
    for frame in frames:
        frame[0, 32:, ::2], frame[0, 32:, 1::2] = 0, 0
        frame[0, 32:, 16::32] = 255
        frame[0, 32:].reshape(160, 8, 32, 3)[:, :, 16:] = 255
    assert doubts(frames) == [()] * 6


@pytest.mark.parametrize("deviation", [1.0, 2.0, 4.0])
@pytest.mark.parametrize("moving", [None, False])
def test_a_camera_at_rest_with_fresh_noise_is_never_accused(deviation, moving):
    assert doubts((at(0, deviation) for _ in range(30)), moving=moving) == [()] * 30


def test_one_that_sees_equal_parts_by_its_codec_is_not_accused_either():
    still = at(0)
    assert doubts([still] * 10, fresh_noise=False) == [()] * 10


@pytest.mark.parametrize("fresh_noise", [True, False])
def test_a_still_picture_of_a_camera_that_moves_is_a_doubt(fresh_noise):
    frames = [*(at(4 * k) for k in range(6)), *(at(20) for _ in range(10)), at(24)]
    told = {"fresh_noise": fresh_noise}
    assert doubts(frames, **told) == [()] * 17
    assert doubts(frames, moving=False, **told) == [()] * 17
    # The fourth picture that shows the same as its predecessors; at(20) is the last one that moved.
    assert doubts(frames, moving=True, **told) == [()] * 9 + [STILL] * 7 + [()]


def test_a_loop_with_fresh_noise_is_found_from_its_ninth_frame_on():
    frames = [at(x) for x in [6 * k for k in range(20)] * 3]
    assert doubts(frames) == [()] * 28 + [REPEATED] * 32
    assert doubts(frames, moving=False) == [()] * 60


@pytest.mark.parametrize("per_frame", [0.335, 0.41, 0.21, 0.3, 0.15])
def test_vibration_of_a_camera_at_rest_is_no_loop(per_frame):
    frames = [at(500 + 6 * np.sin(2.0 * np.pi * per_frame * k)) for k in range(40)]
    assert doubts(frames) == [()] * 40


@settings(max_examples=5, deadline=None)
@given(speed=st.floats(0.1, 8.0), turn=st.integers(10, 25))
def test_a_camera_that_returns_along_its_path_is_not_accused(speed, turn):
    out = [speed * k for k in range(turn)]
    assert doubts([at(x) for x in out + out[::-1]]) == [()] * (2 * turn)


@pytest.mark.parametrize("per_frame", [100 / 30, 100 / 24, 120 / 50, 100 / 60])
def test_a_lamp_that_flickers_row_by_row_does_not_move_the_camera(per_frame):
    rows = np.arange(HEIGHT)[:, np.newaxis, np.newaxis] / HEIGHT
    frames = []
    for k in range(40):
        gain = 1.0 + 0.2 * np.sin(2.0 * np.pi * (per_frame * k + 2.0 * rows))
        frames.append(np.clip(at(0) * gain, 0, 255).astype(np.uint8))
    assert doubts(frames) == [()] * 40


@settings(max_examples=15, deadline=None)
@given(
    size=st.sampled_from([(192, 256), (224, 224), (16, 16), (17, 16), (37, 53)]),
    place=st.tuples(*[st.floats(0, 1, exclude_max=True)] * 2),
    bit=st.integers(0, 7),
)
def test_a_block_has_another_number_exactly_if_one_of_its_bits_differs(size, place, bit):
    height, width = size
    one = NOISE.integers(0, 256, (1, height, width, 3), np.uint8)
    other = one.copy()
    row, column = int(place[0] * height), int(place[1] * 3 * width)
    other.reshape(height, -1)[row, column] ^= 1 << bit
    differ = np.flatnonzero(_block_hashes(one) != _block_hashes(other)).tolist()
    word = 8 if 3 * width >= 64 else 1
    tall, long = height // 6, word * (3 * width // (8 * word))
    inside = row < 6 * tall and column < 8 * long
    assert differ == ([8 * (row // tall) + column // long] if inside else [])


def test_the_smallest_input_is_checked_too():
    images = [at(4 * k)[:, ::12, ::16].copy() for k in range(3)]
    assert images[0].shape == (1, 16, 16, 3)
    assert doubts([*images, images[0]]) == [(), (), (), REPEATED]


def test_the_odometer_takes_the_hint_frame_by_frame_and_for_a_stream(bundle_dir, clip_dir):
    image = next(iter(open_source(str(clip_dir)))).image
    with Odometer.load(bundle_dir, threads=1) as odometer:
        steps = [odometer.step(image, fresh_noise=False, moving=True) for _ in range(5)]
        assert [e.reasons for e in steps] == [()] * 4 + [STILL]
        assert not steps[-1].bounded
        assert odometer.unproven_frames == 5
        streamed = list(odometer.stream([image] * 5, moving=True))
        assert [e.reasons for e in streamed] == [(), *[REPEATED] * 3, REPEATED + STILL]
        assert odometer.unproven_frames == 0


def test_the_summary_says_what_was_not_checked():
    summary = RunSummary(("tx", "ty", "tz", "rx", "ry", "rz"), 0.9, "marginal", unproven=7)
    assert [line for line in summary.lines() if "not checked" in line] == [
        "not checked 7 frames, for parts equal to earlier ones: their codec repeats what stands "
        "still"
    ]


@pytest.mark.parametrize(
    ("codec", "suffix", "fresh"), [("MJPG", "avi", True), ("mp4v", "mp4", False)]
)
def test_a_video_knows_whether_its_codec_keeps_the_noise(tmp_path, codec, suffix, fresh):
    path = tmp_path / f"clip.{suffix}"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*codec), 20.0, (WIDTH, HEIGHT))
    if not writer.isOpened():
        pytest.skip(f"this OpenCV does not write {codec}")
    for k in range(3):
        writer.write(at(k)[0])
    writer.release()
    assert [frame.fresh_noise for frame in open_source(str(path))] == [fresh] * 3


@pytest.mark.parametrize(
    "folder",
    ["redkitchen/seq-01", "kitchen_flights/seq-07", "euroc_mh05/mav0/cam0/data"],
)
def test_real_recordings_are_not_accused_except_of_their_copies(real_data, folder):
    checks, before = Repetition(), None
    for number, frame in enumerate(open_source(str(real_data / folder))):
        if number == 50:
            break
        copied = before is not None and np.array_equal(frame.image, before)
        found = checks.doubts(
            Digest.of(model_input(frame.image, HEIGHT, WIDTH, "none")), moving=True
        )
        assert found == (REPEATED if copied else ())
        before = frame.image
