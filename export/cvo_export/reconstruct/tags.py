"""AprilTags of the family 36h11 in the images, and their corners in the map."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from cvo_edge.geometry import quaternion_to_matrix
from cvo_export.reconstruct.model import Model

Array = NDArray[np.float64]

# Least angle between two rays to a corner; largest reprojection error in pixels of an image 640
# wide, beyond which a view is wrong (a mirrored or misread tag).
_LEAST_ANGLE_RAD = np.deg2rad(1.5)
_LARGEST_PX, _REFERENCE_WIDTH = 3.0, 640


class Sighting(NamedTuple):
    """A tag in an image: its number, the image's row in the model, corners (4, 2) in pixels."""

    tag: int
    row: int
    corners: Array


class Tag(Struct, frozen=True):
    """A tag in the map: ``edge`` is its mean edge in the map's unit, ``edges`` all four."""

    number: int
    views: int
    edge: float
    edges: tuple[float, ...]
    error_px: float


def find_tags(image: NDArray[Any]) -> list[tuple[int, Array]]:
    """Return number and corners (4, 2) of the tags in an image (height, width, 3), BGR."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    corners, numbers, _ = cv2.aruco.ArucoDetector(family, parameters).detectMarkers(image)
    if numbers is None:
        return []
    found = zip(np.ravel(numbers).tolist(), corners, strict=True)
    return [(int(number), np.asarray(each, np.float64).reshape(4, 2)) for number, each in found]


def locate_tags(model: Model, sightings: Sequence[Sighting]) -> list[Tag]:
    """Return the tags whose corners two or more images fix, by number."""
    tags = []
    for number in sorted({each.tag for each in sightings}):
        views = [each for each in sightings if each.tag == number]
        rows = [each.row for each in views]
        if len(set(rows)) == len(rows) and (found := _located(model, number, views)) is not None:
            tags.append(found)
    return tags


def _located(model: Model, number: int, views: Sequence[Sighting]) -> Tag | None:
    """Triangulate a tag, leaving out the worst view as long as one contradicts the others."""
    views = list(views)
    while len(views) >= 2:
        corners = _corners(model, views)
        if corners is None:
            return None
        errors = np.array([_error(model, view, corners) for view in views])
        if errors.max() <= _LARGEST_PX:
            edges = np.linalg.norm(corners - np.roll(corners, -1, axis=0), axis=1)
            spread = tuple(edges.tolist())
            return Tag(number, len(views), float(edges.mean()), spread, float(errors.mean()))
        views.pop(int(errors.argmax()))
    return None


def _corners(model: Model, views: Sequence[Sighting]) -> Array | None:
    """Return the points (4, 3) nearest to the rays of all views; None if they are parallel."""
    centres = np.array([model.poses[view.row, :3] for view in views])
    rays = np.empty((len(views), 4, 3))
    for ray, view in zip(rays, views, strict=True):
        seen = model.cameras[view.row].rays(view.corners)
        R = quaternion_to_matrix(model.poses[view.row, 3:])
        ray[:] = np.column_stack([seen, np.ones(4)]) @ R.T
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    if not np.isfinite(rays).all():
        return None
    cosine = np.einsum("ick,jck->cij", rays, rays).min()
    if cosine > np.cos(_LEAST_ANGLE_RAD):
        return None
    across = np.eye(3) - rays[..., :, None] * rays[..., None, :]
    right = np.einsum("icjk,ik->cj", across, centres)
    return np.asarray(np.linalg.solve(across.sum(axis=0), right[..., None])[..., 0])


def _error(model: Model, view: Sighting, corners: Array) -> float:
    """Return the largest reprojection error of a view, in pixels of an image 640 wide."""
    pose, camera = model.poses[view.row], model.cameras[view.row]
    seen = (corners - pose[:3]) @ quaternion_to_matrix(pose[3:])
    if (seen[:, 2] <= 0).any():
        return np.inf
    off = np.linalg.norm(camera.project(seen) - view.corners, axis=1).max()
    return float(off * _REFERENCE_WIDTH / camera.width)
