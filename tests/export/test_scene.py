"""Laws of the scene: geometrically exact rendering, and the effects of the sensor."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from cvo_edge.geometry import quaternion_exp, quaternion_multiply, quaternion_to_matrix
from cvo_export.datasets.base import Intrinsics
from cvo_export.datasets.synthetic import open_synthetic
from cvo_export.scene.drive import HEIGHT_M, lap
from cvo_export.scene.renderer import Face, Scene
from cvo_export.scene.room import room
from cvo_export.scene.sensor import motion_blur
from cvo_export.scene.street import street

SIZE = (160, 120)
CAMERA = Intrinsics(146.25, 146.25, 79.5, 59.5)
WHITE = np.full((32, 32, 3), 255, np.uint8)


@pytest.fixture(scope="module")
def poses():
    """Poses inside the room, shape (2400, 7)."""
    return open_synthetic("room,flights=40,frames=60").poses


def project(points, pose, camera):
    """Project points (n, 3) to pixels (n, 2) and depths (n,), as the renderer documents it."""
    x, y, z = ((points - pose[:3]) @ quaternion_to_matrix(pose[3:])).T
    return np.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], axis=1), z


def rays(pixels, pose, camera):
    """Return viewing directions (n, 3) of depth 1, in the world frame, for pixels (n, 2)."""
    x, y = ((pixels - (camera.cx, camera.cy)) / (camera.fx, camera.fy)).T
    return np.stack([x, y, np.ones_like(x)], axis=1) @ quaternion_to_matrix(pose[3:]).T


def cast(faces, pixels, pose, camera):
    """Return the colour (n, 3) of the nearest visible face along each ray; NaN without a face."""
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


# ----------------------------------------------------------------------------- renderer and room


@pytest.mark.parametrize("frame", range(0, 2400, 400))
def test_landmarks_appear_where_they_project(poses, frame):
    """Dots painted on a slanted plane have their centroids at the projected pixels."""
    pose = poses[frame]
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


def test_silhouette_is_not_dilated(poses):
    """A white face has the area and the centroid of its projection."""
    pose = poses[7]
    rotation = quaternion_to_matrix(pose[3:])
    corners = np.array([[-0.5, -0.4, 1.7], [0.6, -0.3, 2.1], [0.4, 0.45, 2.0], [-0.7, 0.35, 1.6]])
    corner, u, v = corners[0], corners[1] - corners[0], corners[3] - corners[0]
    face = Face(pose[:3] + rotation @ corner, rotation @ u, rotation @ v, WHITE)
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
def test_face_reaching_behind_the_camera_is_cut_not_lost(poses, length):
    """A floor close below the camera fills the image exactly up to its far edge."""
    pose = poses[0]
    corner = np.add(pose[:3], (-4, length - 1, -0.2))
    floor = Face(corner, np.array([8.0, 0, 0]), np.array([0, -length, 0]), WHITE)
    image = Scene([floor]).render(pose, CAMERA, SIZE)[..., 0]
    pixels = np.stack(np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1])), -1).reshape(-1, 2)
    hit = ~np.isnan(cast([floor], pixels, pose, CAMERA)[:, 0]).reshape(SIZE[::-1])
    assert hit.any()
    assert not hit.all()
    assert not (hit & (image == 0)).any()
    assert not (~hit & (image == 255)).any()


def test_a_face_is_seen_from_its_front_only(poses):
    """The same rectangle is invisible from behind."""
    pose = poses[0]
    rotation = quaternion_to_matrix(pose[3:])
    corner, u, v = np.array([[-1, -1, 2], [2, 0, 0], [0, 2, 0]]) @ rotation.T
    corner = corner + pose[:3]
    assert Scene([Face(corner, u, v, WHITE)]).render(pose, CAMERA, SIZE).any()
    assert not Scene([Face(corner, v, u, WHITE)]).render(pose, CAMERA, SIZE).any()


def test_a_face_seen_edge_on_hides_nothing():
    """A face whose plane contains the camera hides nothing."""
    pose = np.array([0, 0, 0, 0, 0, 0, 1.0])
    behind = Face(np.array([-1.0, -1, 4]), np.array([2.0, 0, 0]), np.array([0, 2.0, 0]), WHITE)
    edge_on = Face(np.array([0, -1.0, 1]), np.array([0, 2.0, 0]), np.array([0, 0, 3.0]), WHITE)
    alone, both = (
        Scene(faces).render(pose, CAMERA, SIZE) for faces in ([behind], [behind, edge_on])
    )
    assert alone.any()
    assert np.array_equal(alone, both)


def misfits(scene, pose, count, shifts):
    """Return the mean difference of a rendering from ray casting, with rays shifted by pixels."""
    image = scene.render(pose, CAMERA, SIZE).astype(float)
    pixels = np.random.default_rng(count).integers((4, 4), (156, 116), (count, 2))
    shown = image[pixels[:, 1], pixels[:, 0]]
    samples = np.stack(np.meshgrid([-0.25, 0.25], [-0.25, 0.25]), -1).reshape(-1, 2)

    def misfit(shift):
        found = [cast(scene.faces, pixels + shift + offset, pose, CAMERA) for offset in samples]
        return np.abs(np.mean(found, axis=0) - shown).mean()

    return [misfit(shift) for shift in shifts]


@pytest.mark.parametrize("frame", [130, 777, 1500, 2222])
def test_room_agrees_with_ray_casting(poses, frame):
    """Every pixel shows the nearest surface on its ray; rays half a pixel off fit worse."""
    shifts = (0, 0), (0.5, 0), (-0.5, 0), (0, 0.5), (0, -0.5)
    exact, *others = misfits(room(), poses[frame], 1500, shifts)
    assert exact < 6
    assert all(other > 1.1 * exact for other in others)


def test_pure_rotation_is_a_homography(poses):
    """A pure rotation warps the image by K R_rel K^-1, independently of depth."""
    camera = Intrinsics(292.5, 292.5, 159.5, 119.5)
    matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    inside = np.ones((240, 320), np.uint8)
    for frame, turn in ((60, (0.05, -0.12, 0.1)), (900, (-0.08, 0.15, -0.05))):
        pose = poses[frame]
        turned = np.array([*pose[:3], *quaternion_multiply(pose[3:], quaternion_exp(turn))])
        # p_turned = R_rel^T p, so the warp maps pixels of the first image to pixels of the second.
        relative = quaternion_to_matrix(quaternion_exp(turn))
        warp = matrix @ relative.T @ np.linalg.inv(matrix)
        first, second = (room().render(p, camera, (320, 240)) for p in (pose, turned))
        expected = cv2.warpPerspective(first, warp, (320, 240))
        overlap = cv2.warpPerspective(inside, warp, (320, 240)) > 0
        overlap = cv2.erode(overlap.astype(np.uint8), np.ones((5, 5))) > 0
        difference = np.abs(expected.astype(float) - second)[overlap]
        assert overlap.mean() > 0.4
        assert difference.mean() < 3.5


# --------------------------------------------------------------------------------------- street


@pytest.fixture(scope="module")
def drives():
    """Poses of two drives of two laps each, shape (2, 400, 7)."""
    return open_synthetic("street,drives=2,frames=400").poses.reshape(2, 400, 7)


def test_street_agrees_with_ray_casting(drives):
    """Nothing is drawn through houses, cars or trees; every ray ends at a face or the sky."""
    exact, other = misfits(street(), drives[0, 40], 400, [(0, 0), (3, 0)])
    assert exact < 10
    assert other > 1.5 * exact


def test_a_lap_is_closed_and_turns_once_around(drives):
    """The car comes back to where it was, one full turn later, and looks everywhere meanwhile."""
    path = lap()
    assert np.allclose(path.place[-1], path.place[0], atol=1e-6)
    assert path.heading[-1] == pytest.approx(2 * np.pi)
    forward = quaternion_to_matrix(drives.reshape(-1, 7)[:, 3:])[..., 2].reshape(2, 400, 3)
    yaw = np.unwrap(np.arctan2(forward[..., 1], forward[..., 0]), axis=1)
    assert (yaw[:, -1] - yaw[:, 0] > 3.5 * np.pi).all()


def test_drives_are_continuous_and_look_ahead(drives):
    """No jump at the end of a lap; the car moves where the camera looks, at constant height."""
    place = drives[..., :3]
    assert np.array_equal(place[..., 2], np.full((2, 400), HEIGHT_M))
    step = np.diff(place, axis=1)
    metres = np.linalg.norm(step, axis=-1)
    assert 0.7 < metres.min() < metres.max() < 2.2
    assert np.linalg.norm(np.diff(step, axis=1), axis=-1).max() < 0.4
    forward = quaternion_to_matrix(drives.reshape(-1, 7)[:, 3:])[..., 2].reshape(2, 400, 3)
    middle = forward[:, 1:] + forward[:, :-1]
    along = np.sum(step * middle, axis=-1) / metres / np.linalg.norm(middle, axis=-1)
    assert along.min() > np.cos(np.radians(3))


def test_the_car_keeps_its_distance_from_everything(drives):
    place = drives.reshape(-1, 7)[:, :3]
    clearance = np.inf
    for corner, u, v, _ in street().faces:
        a = ((place - corner) @ u / (u @ u)).clip(0, 1)
        b = ((place - corner) @ v / (v @ v)).clip(0, 1)
        nearest = corner + a[:, None] * u + b[:, None] * v
        clearance = min(clearance, np.linalg.norm(place - nearest, axis=1).min())
    assert clearance > 0.6


# --------------------------------------------------------------------------------------- sensor


@pytest.mark.parametrize(
    "motion", [(0.02, 0, 0, 0, 0, 0), (0, 0, 0, 0.01, 0, 0), (0, 0, 0, 0, 0.01, 0)]
)
def test_faster_motion_or_longer_exposure_blurs_more(poses, motion):
    """The further the camera travels while the shutter is open, the more the image changes."""
    pose = poses[900]
    sharp = room().render(pose, CAMERA, SIZE)

    def moved(share):
        step = share * np.array(motion)
        turned = quaternion_multiply(pose[3:], quaternion_exp(step[3:]))
        return np.array([*pose[:3] + quaternion_to_matrix(pose[3:]) @ step[:3], *turned])

    change = []
    for exposure in (0, 1, 2, 4, 8):
        blurred = motion_blur(sharp, moved(-exposure / 2), pose, moved(exposure / 2), CAMERA)
        change.append(np.abs(blurred - sharp).mean())
        assert blurred.mean() == pytest.approx(sharp.mean(), rel=0.01)
    assert change[0] == pytest.approx(0, abs=1e-3)
    assert (np.diff(change) > 0.2).all()
