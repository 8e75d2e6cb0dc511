"""What cells of training images should say: points of the place, whatever a copy's camera."""

import cv2
import numpy as np
import pytest

from cvo_edge import geometry
from cvo_edge.camera import Camera
from cvo_export.data.place import (
    DEPTH_WEIGHT,
    LOG_DEPTH,
    POSITION,
    RAY,
    ROTATION,
    SHOWN,
    Place,
)
from cvo_export.data.sparse_map import SparseMap

CAMERA = Camera(
    width=256,
    height=192,
    fx=230.0,
    fy=230.0,
    cx=127.5,
    cy=95.5,
    distortion="radial_tangential",
    coefficients=(-0.1, 0.02, 0.001, -0.001, 0.0),
)
GRID = (12, 16)
# The camera looks along the world's x axis, at a wall in the plane x = 3.
POSE = np.array([0.2, -0.3, 0.1, -0.5, 0.5, -0.5, 0.5])
WALL = 3.0


def place(points, zooms=(1.0,)):
    count = len(points)
    found = SparseMap(
        points,
        np.zeros((count, 128), np.float32),
        np.zeros(count, np.int64),
        np.arange(count),
        depth=2.5,
        error_px=0.5,
    )
    return Place(found, CAMERA, GRID, zooms)


def wall():
    y, z = np.meshgrid(np.linspace(-3.0, 3.0, 81), np.linspace(-3.0, 3.0, 81))
    return np.column_stack([np.full(y.size, WALL), y.ravel(), z.ravel()])


def turned(rotvec):
    rotation = geometry.quaternion_multiply(POSE[3:], geometry.quaternion_exp(np.array(rotvec)))
    return np.concatenate([POSE[:3], rotation])


@pytest.mark.parametrize(
    ("rotvec", "zoom"), [((0.0, 0.0, 0.0), 1.0), ((0.1, -0.05, 0.3), 1.0), ((0.0, 0.2, -0.2), 1.3)]
)
def test_the_points_of_all_cells_lie_on_the_wall_that_they_show(rotvec, zoom):
    poses = np.stack([POSE, turned(rotvec)])[:, np.newaxis]
    cells = place(wall(), (1.0, zoom)).targets(poses)[1, 0].astype(np.float64)
    in_camera = np.column_stack([cells[:, RAY], np.ones(len(cells))])
    in_camera *= np.exp(cells[:, LOG_DEPTH, np.newaxis])
    R = cells[:, ROTATION].reshape(-1, 3, 3)
    world = np.einsum("nij,nj->ni", R, in_camera) + cells[:, POSITION]
    np.testing.assert_allclose(world[:, 0], WALL, atol=0.05)
    assert cells[:, DEPTH_WEIGHT].min() > 0.9
    # OpenCV's projection of those points: a cell is shown if the unchanged image contains them.
    matrix = geometry.quaternion_to_matrix(POSE[3:]).T
    projected, _ = cv2.projectPoints(
        world,
        cv2.Rodrigues(matrix)[0],
        -matrix @ POSE[:3],
        CAMERA.matrix,
        np.array(CAMERA.coefficients),
    )
    x, y = projected[:, 0].T
    inside = (x > 0.0) & (x < 255.0) & (y > 0.0) & (y < 191.0)
    near_the_edge = (np.abs(x - 127.5) < 132.0) & (np.abs(y - 95.5) < 100.0) & ~inside
    assert cells[inside, SHOWN].all()
    assert not cells[~inside & ~near_the_edge, SHOWN].any()
    assert inside.any()
    if np.any(rotvec):
        assert not cells[:, SHOWN].all()


def test_the_depth_of_a_cell_far_from_any_point_has_little_weight():
    """One point, seen in the middle: its cells trust its depth, a corner hardly."""
    cells = place(np.array([[WALL, -0.3, 0.1]])).targets(POSE[np.newaxis, np.newaxis])[0, 0]
    np.testing.assert_allclose(np.exp(cells[:, LOG_DEPTH]), WALL - POSE[0], rtol=1e-6)
    weight = cells[:, DEPTH_WEIGHT].reshape(GRID)
    assert weight[5:7, 7:9].min() > 0.7
    assert weight[0, 0] == pytest.approx(0.05)


def test_without_points_cells_have_the_typical_depth_and_the_least_weight():
    behind = np.array([[-WALL, 0.0, 0.0]])
    for points in (np.empty((0, 3)), behind):
        cells = place(points).targets(POSE[np.newaxis, np.newaxis])[0, 0]
        np.testing.assert_allclose(np.exp(cells[:, LOG_DEPTH]), 2.5, rtol=1e-6)
        np.testing.assert_allclose(cells[:, DEPTH_WEIGHT], 0.05)
