"""Laws of the synthetic room: reproducible, prefix-stable, and geometrically exact."""

from __future__ import annotations

import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import pytest

from cvo_edge.errors import UsageError
from cvo_edge.geometry import quaternion_exp, quaternion_multiply, quaternion_to_matrix
from cvo_export.datasets.base import Intrinsics
from cvo_export.datasets.synthetic import ROOM_M, Face, Scene, open_room, room

SMALL = "room,flights=3,frames=4,size=96x72"
SIZE = (160, 120)
CAMERA = Intrinsics(146.25, 146.25, 79.5, 59.5)


@pytest.fixture(scope="module")
def flights():
    """Many poses; their images are not needed."""
    return open_room("room,flights=40,frames=60,size=160x120")


def project(points, pose, camera):
    """World points (n, 3) -> pixels (n, 2) and depths (n,), as the module's docstring states it."""
    x, y, z = ((points - pose[:3]) @ quaternion_to_matrix(pose[3:])).T
    return np.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], axis=1), z


def rays(pixels, pose, camera):
    """Pixels (n, 2) -> viewing directions (n, 3) in the world frame, of depth one."""
    x, y = ((pixels - (camera.cx, camera.cy)) / (camera.fx, camera.fy)).T
    return np.stack([x, y, np.ones_like(x)], axis=1) @ quaternion_to_matrix(pose[3:]).T


def cast(faces, pixels, pose, camera):
    """Colour (n, 3) of the nearest face that faces the camera along each ray; NaN where none."""
    directions = rays(pixels, pose, camera)
    nearest = np.full(len(pixels), np.inf)
    colours = np.full((len(pixels), 3), np.nan)
    for corner, u, v, texture in faces:
        away = np.cross(u, v)
        if (corner - pose[:3]) @ away <= 0:
            continue
        depth = ((corner - pose[:3]) @ away) / (directions @ away)
        on_face = pose[:3] + depth[:, None] * directions - corner
        a, b = on_face @ u / (u @ u), on_face @ v / (v @ v)
        hit = (depth > 0) & (depth < nearest) & (a >= 0) & (a < 1) & (b >= 0) & (b < 1)
        rows, columns = texture.shape[:2]
        nearest[hit] = depth[hit]
        colours[hit] = texture[(b[hit] * rows).astype(int), (a[hit] * columns).astype(int)]
    return colours


# ------------------------------------------------------------------------------------ interface


def test_default_is_48_flights_of_50_frames():
    """The bare name asks for the documented sizes; nothing is rendered to answer."""
    dataset = open_room()
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
    """Each pose is finite, float64, and its quaternion has norm one."""
    assert flights.poses.shape == (2400, 7)
    assert flights.poses.dtype == np.float64
    assert np.allclose(np.linalg.norm(flights.poses[:, 3:], axis=1), 1, atol=1e-12)


def test_images_have_the_size_asked_for():
    """Images are uint8 BGR of the requested width and height, also at odd sizes."""
    image = open_room("room,flights=1,frames=1,size=101x63").read_image(0)
    assert image.shape == (63, 101, 3)
    assert image.dtype == np.uint8


def test_opening_paints_nothing():
    """Neither importing nor opening builds the textures: reading the first image does."""
    code = (
        "from cvo_export.datasets import synthetic as s; d = s.open_room();"
        "assert s.room.cache_info().currsize == 0; d.read_image(0);"
        "assert s.room.cache_info().currsize == 1"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize(
    ("spec", "expected", "found"),
    [
        ("hall", "room", "hall"),
        ("", "room", "''"),
        ("room,", "flights=", "''"),
        ("room,colour=red", "flights=", "colour=red"),
        ("room,flights", "1..1000", "flights"),
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
        ("room,seed=1,seed=1", "seed once", "again"),
        ("room,size=64x48,size=64x48", "size once", "again"),
    ],
)
def test_bad_specification_is_refused(spec, expected, found):
    """One line names what was expected and what was found."""
    with pytest.raises(UsageError) as error:
        open_room(spec)
    message = str(error.value)
    assert expected in message
    assert found in message
    assert "\n" not in message


def test_frame_past_the_end_is_an_index_error():
    """There is no frame after the last one."""
    with pytest.raises(IndexError):
        open_room(SMALL).read_image(12)


# ---------------------------------------------------------------------------------- determinism


def test_images_are_identical_in_any_order_and_thread():
    """A frame's bytes depend on its number alone."""
    first, second = open_room(SMALL), open_room(SMALL)
    forwards = [first.read_image(i) for i in range(12)]
    with ThreadPoolExecutor(2) as pool:
        backwards = list(pool.map(second.read_image, reversed(range(12))))[::-1]
    assert np.array_equal(first.poses, second.poses)
    assert np.array_equal(forwards, backwards)


def test_more_flights_and_frames_leave_the_earlier_ones_unchanged():
    """Flight i, frame j is the same in a longer data set."""
    short = open_room(SMALL)
    long = open_room("room,flights=5,frames=9,size=96x72")
    same = [9 * flight + frame for flight in range(3) for frame in range(4)]
    assert np.array_equal(short.poses, long.poses[same])
    assert short.frame_names == tuple(long.frame_names[i] for i in same)
    for i in (0, 7, 11):
        assert np.array_equal(short.read_image(i), long.read_image(same[i]))


def test_seed_draws_other_flights():
    """Another seed gives other trajectories."""
    assert not np.allclose(open_room(SMALL).poses, open_room(SMALL + ",seed=1").poses, atol=0.01)


# ------------------------------------------------------------------------------------- flights


def test_flights_fill_the_documented_volume(flights):
    """Positions spread over about 1.6 x 1.2 x 0.6 m and never leave it."""
    position = flights.poses[:, :3]
    reach = np.array([0.8, 0.6, 0.3])
    offset = position - (0, -0.4, 1.3)
    assert (np.abs(offset) <= reach).all()
    assert (np.ptp(position, axis=0) > 1.6 * reach).all()
    assert np.allclose(position.std(axis=0), (0.35, 0.26, 0.13), rtol=0.2)


def test_camera_looks_forward_within_its_limits(flights):
    """Yaw stays within 35, pitch within 15 and roll within 8 degrees, and all of them are used."""
    right, _, forward = np.moveaxis(quaternion_to_matrix(flights.poses[:, 3:]), -1, 0)
    yaw = np.degrees(np.arctan2(-forward[:, 0], forward[:, 1]))
    pitch = np.degrees(np.arcsin(forward[:, 2]))
    roll = np.degrees(np.arcsin(-right[:, 2] / np.cos(np.radians(pitch))))
    for angle, limit in ((yaw, 35), (pitch, 15), (roll, 8)):
        assert 0.75 * limit < np.abs(angle).max() <= limit + 1e-9


def test_motion_is_smooth_and_slow(flights):
    """A frame moves about 2 cm and 1 degree on, and velocity changes little from frame to frame."""
    poses = flights.poses.reshape(40, 60, 7)
    step = np.diff(poses[..., :3], axis=1)
    dot = np.abs(np.sum(poses[:, 1:, 3:] * poses[:, :-1, 3:], axis=-1)).clip(0, 1)
    assert 0.015 < np.linalg.norm(step, axis=-1).mean() < 0.025
    assert 0.7 < np.degrees(2 * np.arccos(dot)).mean() < 1.4
    assert np.linalg.norm(np.diff(step, axis=1), axis=-1).max() < 0.008


def test_every_flight_starts_within_the_others_volume(flights):
    """New flights interpolate: around each first pose, other flights have been within 25 cm."""
    position = flights.poses[:, :3].reshape(40, 60, 3)
    near = []
    for number, start in enumerate(position[:, 0]):
        others = np.delete(position, number, axis=0).reshape(-1, 3)
        near.append(np.linalg.norm(others - start, axis=1).min())
    assert np.quantile(near, 0.9) < 0.25
    assert np.linalg.norm(position[:, 0].std(axis=0)) > 0.3


def test_camera_keeps_half_a_metre_from_everything():
    """No point of the flights' volume is within 0.5 m of a wall or of furniture, or inside it."""
    axes = [np.linspace(a, b, 9) for a, b in ((-0.8, 0.8), (-1.0, 0.2), (1.0, 1.6))]
    volume = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 3)
    clearance = np.inf
    for corner, u, v, _ in room().faces:
        # The nearest point of a rectangle: clamp the coordinates along its two sides.
        a = ((volume - corner) @ u / (u @ u)).clip(0, 1)
        b = ((volume - corner) @ v / (v @ v)).clip(0, 1)
        nearest = corner + a[:, None] * u + b[:, None] * v
        clearance = min(clearance, np.linalg.norm(volume - nearest, axis=1).min())
    assert clearance >= 0.5
    # No surface cuts the volume: it lies inside the room, and no furniture is large enough for it.
    assert (np.abs(volume[:, :2]) < ROOM_M[:2] / 2).all()
    assert (volume[:, 2] < ROOM_M[2]).all()


# ------------------------------------------------------------------------------------- geometry


@pytest.mark.parametrize("frame", range(0, 2400, 400))
def test_landmarks_appear_where_they_project(flights, frame):
    """Dots painted on a slanted plane have their centroids at the projected pixels."""
    pose = flights.poses[frame]
    rotation = quaternion_to_matrix(pose[3:])
    texture = np.zeros((600, 800, 3), np.uint8)
    spots = np.stack(np.meshgrid(np.arange(100, 800, 150), np.arange(100, 600, 130)), -1)
    spots = spots.reshape(-1, 2)
    for column, row in spots.tolist():
        cv2.circle(texture, (column, row), 12, (255, 255, 255), -1, cv2.LINE_AA)
    u, v = rotation @ (1.6, 0.1, 0.5), rotation @ (-0.1, 1.2, 0.3)
    corner = pose[:3] + rotation @ (-0.8, -0.7, 1.8)
    image = Scene([Face(corner, u, v, texture)]).render(pose, CAMERA, SIZE).astype(float)
    fractions = (spots + 0.5) / (800, 600)
    pixels, _ = project(corner + fractions @ np.array([u, v]), pose, CAMERA)
    columns, rows = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    errors = []
    for x, y in pixels:
        if 6 < x < SIZE[0] - 7 and 6 < y < SIZE[1] - 7:
            light = image[..., 0] * (np.hypot(columns - x, rows - y) < 5)
            found = np.array([(light * columns).sum(), (light * rows).sum()]) / light.sum()
            errors.append(np.hypot(*(found - (x, y))))
    assert len(errors) >= 10
    assert max(errors) < 0.1


def test_silhouette_is_not_dilated(flights):
    """A white face covers as much of the image as its projection, with the same centroid."""
    pose = flights.poses[7]
    rotation = quaternion_to_matrix(pose[3:])
    corners = np.array([[-0.5, -0.4, 1.7], [0.6, -0.3, 2.1], [0.4, 0.45, 2.0], [-0.7, 0.35, 1.6]])
    corner, u, v = corners[0], corners[1] - corners[0], corners[3] - corners[0]
    white = np.full((32, 32, 3), 255, np.uint8)
    face = Face(pose[:3] + rotation @ corner, rotation @ u, rotation @ v, white)
    cover = Scene([face]).render(pose, CAMERA, SIZE)[..., 0] / 255.0
    outline = np.array([face.corner, face.corner + face.edge_u])
    outline = np.array([*outline, outline[1] + face.edge_v, face.corner + face.edge_v])
    x, y = project(outline, pose, CAMERA)[0].T
    cross = x * np.roll(y, -1) - np.roll(x, -1) * y
    area = cross.sum() / 2
    middle = [((p + np.roll(p, -1)) * cross).sum() / (6 * area) for p in (x, y)]
    columns, rows = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    assert cover.sum() == pytest.approx(area, rel=0.005)
    assert (cover * columns).sum() / cover.sum() == pytest.approx(middle[0], abs=0.05)
    assert (cover * rows).sum() / cover.sum() == pytest.approx(middle[1], abs=0.05)


@pytest.mark.parametrize("length", [2.3, 2.6, 2.9, 3.2])
def test_face_reaching_behind_the_camera_is_cut_not_lost(flights, length):
    """A floor that passes close under the camera fills the image exactly up to its far edge."""
    pose = flights.poses[0]
    white = np.full((32, 32, 3), 255, np.uint8)
    corner = np.add(pose[:3], (-4, length - 1, -0.2))
    floor = Face(corner, np.array([8.0, 0, 0]), np.array([0, -length, 0]), white)
    image = Scene([floor]).render(pose, CAMERA, SIZE)[..., 0]
    pixels = np.stack(np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1])), -1).reshape(-1, 2)
    hit = ~np.isnan(cast([floor], pixels, pose, CAMERA)[:, 0]).reshape(SIZE[::-1])
    assert hit.any()
    assert not hit.all()
    assert not (hit & (image == 0)).any()
    assert not (~hit & (image == 255)).any()


def test_a_face_is_seen_from_its_front_only(flights):
    """Turned round, the same rectangle is invisible."""
    pose = flights.poses[0]
    rotation = quaternion_to_matrix(pose[3:])
    white = np.full((32, 32, 3), 255, np.uint8)
    corner, u, v = np.array([[-1, -1, 2], [2, 0, 0], [0, 2, 0]]) @ rotation.T
    corner = corner + pose[:3]
    assert Scene([Face(corner, u, v, white)]).render(pose, CAMERA, SIZE).any()
    assert not Scene([Face(corner, v, u, white)]).render(pose, CAMERA, SIZE).any()


@pytest.mark.parametrize("frame", [130, 777, 1500, 2222])
def test_room_agrees_with_ray_casting(flights, frame):
    """Every pixel shows the nearest surface on its ray; half a pixel aside fits worse."""
    pose = flights.poses[frame]
    image = room().render(pose, CAMERA, SIZE).astype(float)
    pixels = np.random.default_rng(frame).integers((4, 4), (156, 116), (1500, 2))
    shown = image[pixels[:, 1], pixels[:, 0]]
    samples = np.stack(np.meshgrid([-0.25, 0.25], [-0.25, 0.25]), -1).reshape(-1, 2)

    def misfit(shift):
        faces = room().faces
        cast_colours = [cast(faces, pixels + shift + offset, pose, CAMERA) for offset in samples]
        return np.abs(np.mean(cast_colours, axis=0) - shown).mean()

    exact = misfit((0, 0))
    assert exact < 6
    assert all(misfit(shift) > 1.1 * exact for shift in ((0.5, 0), (-0.5, 0), (0, 0.5), (0, -0.5)))


def test_pure_rotation_is_a_homography(flights):
    """Turning on the spot warps the image by K R_rel K^-1, whatever the depth."""
    camera = Intrinsics(292.5, 292.5, 159.5, 119.5)
    matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    inside = np.ones((240, 320), np.uint8)
    for frame, turn in ((60, (0.05, -0.12, 0.1)), (900, (-0.08, 0.15, -0.05))):
        pose = flights.poses[frame]
        turned = np.array([*pose[:3], *quaternion_multiply(pose[3:], quaternion_exp(turn))])
        # p_turned = R_rel^T p, hence the warp takes a pixel of the first image to the second's.
        relative = quaternion_to_matrix(quaternion_exp(turn))
        warp = matrix @ relative.T @ np.linalg.inv(matrix)
        first, second = (room().render(p, camera, (320, 240)) for p in (pose, turned))
        expected = cv2.warpPerspective(first, warp, (320, 240))
        overlap = cv2.warpPerspective(inside, warp, (320, 240)) > 0
        overlap = cv2.erode(overlap.astype(np.uint8), np.ones((5, 5))) > 0
        difference = np.abs(expected.astype(float) - second)[overlap]
        assert overlap.mean() > 0.4
        assert difference.mean() < 3.5


def test_photograph_shows_what_the_pose_says(flights):
    """Light, blur and noise do not move the image against its pose."""
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
    """Brightness and colour vary from flight to flight more than sensor noise does."""
    dataset = open_room("room,flights=8,frames=1,size=96x72")
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
    """Image distance grows with pose distance: one image tells where it was taken."""
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
