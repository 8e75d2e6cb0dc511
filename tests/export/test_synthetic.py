"""Laws of the synthetic data set: reproducibility, stable prefixes, and the flights' volume."""

from __future__ import annotations

import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import pytest

from cvo_edge.errors import UsageError
from cvo_edge.geometry import quaternion_to_matrix
from cvo_export.datasets.base import Intrinsics
from cvo_export.datasets.synthetic import open_synthetic
from cvo_export.scene.room import ROOM_M, room, tagged_room

SMALL = "room,flights=3,frames=4,size=96x72"
SIZE = (160, 120)


@pytest.fixture(scope="module")
def flights():
    """Many flights, of which only the poses are used."""
    return open_synthetic("room,flights=40,frames=60,size=160x120")


# ------------------------------------------------------------------------------------ interface


def test_default_is_48_flights_of_50_frames():
    """The bare name gives the documented sizes, without rendering."""
    dataset = open_synthetic()
    assert dataset.name == "synthetic-room"
    assert len(dataset) == 48 * 50 == len(dataset.frame_names) == len(set(dataset.frame_names))
    assert dataset.sequence_names[:2] == ("flight-01", "flight-02")
    assert dataset.frame_names[50] == "flight-02/frame-000000"
    assert dataset.intrinsics == Intrinsics(292.5, 292.5, 159.5, 119.5)
    assert np.array_equal(dataset.sequence, np.arange(2400) // 50)
    assert not dataset.own_train
    assert not dataset.own_test
    assert not dataset.skipped


def test_poses_are_unit_quaternions(flights):
    """Poses are finite float64 numbers with quaternions of norm 1."""
    assert flights.poses.shape == (2400, 7)
    assert flights.poses.dtype == np.float64
    assert np.allclose(np.linalg.norm(flights.poses[:, 3:], axis=1), 1, atol=1e-12)


def test_images_have_the_size_asked_for():
    """Images are uint8 BGR of the requested size, including odd sizes."""
    image = open_synthetic("room,flights=1,frames=1,size=101x63").read_image(0)
    assert image.shape == (63, 101, 3)
    assert image.dtype == np.uint8


def test_opening_paints_nothing():
    """The textures are built when the first image is read, not on import or open."""
    code = (
        "from cvo_export.datasets.synthetic import open_synthetic; d = open_synthetic();"
        "from cvo_export.scene.room import room; assert room.cache_info().currsize == 0;"
        "d.read_image(0); assert room.cache_info().currsize == 1"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize(
    ("spec", "expected", "found"),
    [
        ("hall", "room", "hall"),
        ("", "room", "''"),
        ("room,", "flights=", "''"),
        ("room,colour=red", "flights=", "colour=red"),
        ("room,flights", "flights=", "flights"),
        ("room,flights=0", "1..1000", "flights=0"),
        ("room,flights=1001", "1..1000", "flights=1001"),
        ("room,flights=-3", "1..1000", "flights=-3"),
        ("room,flights=3.5", "1..1000", "flights=3.5"),
        ("room,flights=\u0663", "1..1000", "\u0663"),
        ("room,frames=0", "1..10000", "frames=0"),
        ("room,frames=10001", "1..10000", "frames=10001"),
        ("room,size=320", "64x48 and 1920x1080", "size=320"),
        ("room,size=63x48", "64x48 and 1920x1080", "size=63x48"),
        ("room,size=64x47", "64x48 and 1920x1080", "size=64x47"),
        ("room,size=1921x1080", "64x48 and 1920x1080", "size=1921x1080"),
        ("room,size=1920x1081", "64x48 and 1920x1080", "size=1920x1081"),
        ("room,size=320x240x3", "64x48 and 1920x1080", "size=320x240x3"),
        ("room,seed=-1", "seed=0..4294967295", "seed=-1"),
        ("room,seed=4294967296", "seed=0..4294967295", "seed=4294967296"),
        ("room,seed=1,seed=1", "tag= once", "seed=1"),
        ("room,still=z,still=z", "tag= once", "still=z"),
        ("room,drives=2", "flights=", "drives=2"),
        ("street,flights=2", "drives=, frames=, size=, seed= once", "flights=2"),
        ("street,turn=1", "drives=, frames=, size=, seed= once", "turn=1"),
        ("street,drives=1001", "drives=1..1000", "drives=1001"),
    ],
)
def test_bad_specification_is_refused(spec, expected, found):
    """One line states what was expected and what was found."""
    with pytest.raises(UsageError) as error:
        open_synthetic(spec)
    message = str(error.value)
    assert expected in message
    assert found in message
    assert "\n" not in message


def test_frame_past_the_end_is_an_index_error():
    """Reading past the last frame raises IndexError."""
    with pytest.raises(IndexError):
        open_synthetic(SMALL).read_image(12)


# ---------------------------------------------------------------------------------- determinism


def test_images_are_identical_in_any_order_and_thread():
    """A frame's bytes depend only on its number."""
    first, second = open_synthetic(SMALL), open_synthetic(SMALL)
    forwards = [first.read_image(i) for i in range(12)]
    with ThreadPoolExecutor(2) as pool:
        backwards = list(pool.map(second.read_image, reversed(range(12))))[::-1]
    assert np.array_equal(first.poses, second.poses)
    assert np.array_equal(forwards, backwards)


def test_more_flights_and_frames_leave_the_earlier_ones_unchanged():
    """Flight i, frame j is the same in a longer data set."""
    short = open_synthetic(SMALL)
    long = open_synthetic("room,flights=5,frames=9,size=96x72")
    same = [9 * flight + frame for flight in range(3) for frame in range(4)]
    assert np.array_equal(short.poses, long.poses[same])
    assert short.frame_names == tuple(long.frame_names[i] for i in same)
    for i in (0, 7, 11):
        assert np.array_equal(short.read_image(i), long.read_image(same[i]))


def test_drives_depend_on_their_number_alone():
    """Drive i, frame j is the same in a longer data set, and without the option by default."""
    long = open_synthetic("street")
    assert long.name == "synthetic-street"
    assert long.sequence_names[:2] == ("drive-01", "drive-02")
    short = open_synthetic("street,drives=3,frames=7")
    same = [200 * drive + frame for drive in range(3) for frame in range(7)]
    assert np.array_equal(short.poses, long.poses[same])


def test_seed_draws_other_flights():
    """Another seed gives other trajectories."""
    assert not np.allclose(
        open_synthetic(SMALL).poses, open_synthetic(SMALL + ",seed=1").poses, atol=0.01
    )


# ------------------------------------------------------------------------------------- flights


def test_flights_fill_the_documented_volume(flights):
    """Positions spread over about 0.8 x 0.6 x 0.3 m and never leave it."""
    position = flights.poses[:, :3]
    reach = np.array([0.4, 0.3, 0.15])
    offset = position - (0, -0.4, 1.3)
    assert (np.abs(offset) <= reach).all()
    assert (np.ptp(position, axis=0) > 1.6 * reach).all()
    assert np.allclose(position.std(axis=0), (0.175, 0.13, 0.065), rtol=0.2)


def test_camera_looks_forward_within_its_limits(flights):
    """Flights use the whole ranges of yaw (17.5), pitch (7.5) and roll (4 degrees), but no more."""
    right, _, forward = np.moveaxis(quaternion_to_matrix(flights.poses[:, 3:]), -1, 0)
    yaw = np.degrees(np.arctan2(-forward[:, 0], forward[:, 1]))
    pitch = np.degrees(np.arcsin(forward[:, 2]))
    roll = np.degrees(np.arcsin(-right[:, 2] / np.cos(np.radians(pitch))))
    for angle, limit in ((yaw, 17.5), (pitch, 7.5), (roll, 4)):
        assert 0.75 * limit < np.abs(angle).max() <= limit + 1e-9


def test_motion_is_smooth_and_slow(flights):
    """The camera moves about 1.6 cm and 0.6 degrees per frame, and its velocity changes slowly."""
    poses = flights.poses.reshape(40, 60, 7)
    step = np.diff(poses[..., :3], axis=1)
    dot = np.abs(np.sum(poses[:, 1:, 3:] * poses[:, :-1, 3:], axis=-1)).clip(0, 1)
    assert 0.012 < np.linalg.norm(step, axis=-1).mean() < 0.02
    assert 0.5 < np.degrees(2 * np.arccos(dot)).mean() < 0.75
    assert np.linalg.norm(np.diff(step, axis=1), axis=-1).max() < 0.006


def test_every_flight_starts_within_the_others_volume(flights):
    """New flights interpolate: other flights pass within 10 cm of each first pose."""
    position = flights.poses[:, :3].reshape(40, 60, 3)
    near = []
    for number, start in enumerate(position[:, 0]):
        others = np.delete(position, number, axis=0).reshape(-1, 3)
        near.append(np.linalg.norm(others - start, axis=1).min())
    assert np.quantile(near, 0.9) < 0.1
    assert np.linalg.norm(position[:, 0].std(axis=0)) > 0.15


def test_camera_keeps_its_distance_from_everything():
    """Every point of the flights' volume is at least 0.9 m from walls and furniture."""
    axes = [np.linspace(a, b, 9) for a, b in ((-0.4, 0.4), (-0.7, -0.1), (1.15, 1.45))]
    volume = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 3)
    clearance = np.inf
    for corner, u, v, _ in room().faces:
        # Clamping the coordinates along both sides gives the nearest point of a rectangle.
        a = ((volume - corner) @ u / (u @ u)).clip(0, 1)
        b = ((volume - corner) @ v / (v @ v)).clip(0, 1)
        nearest = corner + a[:, None] * u + b[:, None] * v
        clearance = min(clearance, np.linalg.norm(volume - nearest, axis=1).min())
    assert clearance >= 0.9
    # The volume lies inside the room, and no furniture is large enough to contain it.
    assert (np.abs(volume[:, :2]) < ROOM_M[:2] / 2).all()
    assert (volume[:, 2] < ROOM_M[2]).all()


# ---------------------------------------------------------------------------------- photographs


def test_photograph_shows_what_the_pose_says(flights):
    """Light, blur and noise do not shift the image relative to its pose."""
    for frame in range(30, 2400, 500):
        clean = room().render(flights.poses[frame], flights.intrinsics, SIZE)
        grey = [
            cv2.cvtColor(image, cv2.COLOR_BGR2GRAY).astype(np.float32)
            for image in (clean, flights.read_image(frame))
        ]
        window = cv2.createHanningWindow(SIZE, cv2.CV_32F)
        shift, _ = cv2.phaseCorrelate(*grey, window)
        assert np.hypot(*shift) < 0.15


def test_flights_differ_in_light():
    """Brightness and colour vary more between flights than sensor noise does."""
    dataset = open_synthetic("room,flights=8,frames=1,size=96x72")
    ratios = [
        dataset.read_image(i).mean(axis=(0, 1))
        / room().render(dataset.poses[i], dataset.intrinsics, (96, 72)).mean(axis=(0, 1))
        for i in range(8)
    ]
    blue, _, red = np.log(ratios).T
    assert (np.std(ratios, axis=0) > 0.06).all()
    assert np.std(blue - red) > 0.05
    assert np.min(ratios) > 0.6
    assert np.max(ratios) < 1.4


def test_near_poses_look_alike_and_far_ones_do_not(flights):
    """Image distance grows with pose distance, so an image determines its pose."""
    frames = np.arange(0, 2400, 120)
    render = room().render
    images, neighbours = (
        np.array([render(flights.poses[i], flights.intrinsics, SIZE) for i in frames + k], float)
        for k in (0, 1)
    )
    images, neighbours = (
        np.array([cv2.GaussianBlur(image, (0, 0), 3) for image in stack])
        for stack in (images, neighbours)
    )
    distance = np.abs(neighbours[:, None] - images[None]).mean(axis=(2, 3, 4))
    assert (distance.argmin(axis=1) == np.arange(len(frames))).all()
    off_diagonal = distance[~np.eye(len(frames), dtype=bool)]
    assert np.median(off_diagonal) > 3 * np.median(np.diag(distance))


# -------------------------------------------------------------------------------------- the tag


def test_a_tag_changes_only_its_own_pixels():
    """Without the option nothing changes; with it, the rest of the frame keeps its pixels."""
    plain = open_synthetic("room,flights=1,frames=1,size=320x240").read_image(0)
    tagged = open_synthetic("room,flights=1,frames=1,size=320x240,tag=0.2").read_image(0)
    rows, columns = np.nonzero((plain != tagged).any(axis=2))
    # The paper measures 0.25 m at 2.4 m distance: about 30 pixels.
    assert 20 < np.ptp(rows) < 40
    assert 20 < np.ptp(columns) < 40
    assert room().faces == tagged_room(0.2).faces[:-1]


def test_the_tag_has_its_edge_length_at_its_place():
    """The corners that a detector finds are the projections of a square of 0.2 m on the wall."""
    dataset = open_synthetic("room,flights=1,frames=1,size=640x480,tag=0.2")
    family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    corners, numbers, _ = cv2.aruco.ArucoDetector(family).detectMarkers(dataset.read_image(0))
    assert np.ravel(numbers).tolist() == [0]
    face = tagged_room(0.2).faces[-1]
    share = np.array([[0.1, 0.1], [0.9, 0.1], [0.9, 0.9], [0.1, 0.9]])
    square = face.corner + share @ np.array([face.edge_u, face.edge_v])
    assert np.allclose(np.linalg.norm(square - np.roll(square, 1, axis=0), axis=1), 0.2)
    seen = (square - dataset.poses[0, :3]) @ quaternion_to_matrix(dataset.poses[0, 3:])
    fx, fy, cx, cy = dataset.intrinsics
    pixels = seen[:, :2] / seen[:, 2:] * (fx, fy) + (cx, cy)
    assert np.abs(pixels - corners[0].reshape(4, 2)).max() < 1.0


@pytest.mark.parametrize("item", ["tag=0", "tag=0.5", "tag=nan", "tag=20cm"])
def test_a_tag_that_fits_no_wall_is_refused(item):
    with pytest.raises(UsageError, match=r"expected tag=0\.02\.\.0\.3 in metres, found"):
        open_synthetic(f"room,{item}")
