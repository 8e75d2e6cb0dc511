"""Triangulated maps: points lie where the scene is, in the unit of the poses."""

import numpy as np
import pytest

from cvo_edge import geometry
from cvo_edge.errors import SourceError
from cvo_export.data.sparse_map import keypoints, read_sparse_map, sparse_map, write_sparse_map
from cvo_export.datasets import open_dataset


@pytest.fixture(scope="module")
def flights():
    return open_dataset("synthetic:room,flights=4,frames=12,size=320x240")


@pytest.fixture(scope="module")
def images(flights):
    return [flights.read_image(index) for index in range(len(flights))]


@pytest.fixture(scope="module")
def built(flights, images):
    return made(images, flights.poses, flights.camera())


def made(images, poses, camera, seed=0):
    return sparse_map(images.__getitem__, poses, camera, seed, lambda *_: None)


def test_points_reproject_onto_other_images_of_the_scene(flights, images, built):
    """A frame that the map was not made from sees its keypoints at the map's points."""
    assert len(built.points) > 200
    assert built.error_px < 1.0
    other = open_dataset("synthetic:room,flights=5,frames=12,size=320x240")
    index, camera = 4 * 12 + 6, other.camera()
    found = keypoints(other.read_image(index), camera)
    likeness = found.descriptors @ built.descriptors.T
    best = likeness.argmax(axis=1)
    mutual = likeness.argmax(axis=0)[best] == np.arange(len(best))
    pose = other.poses[index]
    seen = (built.points[best] - pose[:3]) @ geometry.quaternion_to_matrix(pose[3:])
    ahead = mutual & (seen[:, 2] > 0.1)
    error = np.linalg.norm(seen[:, :2] / seen[:, 2:] - found.rays, axis=1)[ahead] * camera.fx
    assert np.count_nonzero(error < 3.0) > 30


def test_points_scale_with_the_poses(flights, images, built):
    poses = flights.poses.copy()
    poses[:, :3] *= 10.0
    larger = made(images, poses, flights.camera())
    np.testing.assert_allclose(larger.points, 10.0 * built.points, rtol=1e-3, atol=1e-2)
    assert larger.depth == pytest.approx(10.0 * built.depth, rel=1e-3)


def test_every_point_has_three_views_in_different_frames(built):
    pairs = np.stack([built.point, built.frame])
    assert np.unique(pairs, axis=1).shape == pairs.shape
    assert np.bincount(built.point).min() >= 3
    assert np.bincount(built.point).size == len(built.points)


def test_a_map_is_read_back(built, tmp_path):
    write_sparse_map(built, tmp_path / "map.npz")
    again = read_sparse_map(tmp_path / "map.npz")
    for name, values in built._asdict().items():
        np.testing.assert_array_equal(getattr(again, name), values)
    content = (tmp_path / "map.npz").read_bytes()
    (tmp_path / "map.npz").write_bytes(content[: len(content) // 2])
    assert read_sparse_map(tmp_path / "map.npz") is None
    assert read_sparse_map(tmp_path / "none.npz") is None


def test_a_camera_that_only_turns_gives_no_map(flights, images):
    poses = flights.poses.copy()
    poses[:, :3] = poses[0, :3]
    with pytest.raises(SourceError, match="map: expected points seen from 3 places"):
        made(images, poses, flights.camera())
