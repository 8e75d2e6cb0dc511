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
# A tag's black square has 8 modules a side. Its edges are measured at some places along a side, in
# profiles that reach half a module to either side.
_MODULES, _SAMPLES, _PROFILE, _ROUNDS = 8, 24, 15, 2


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
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY).astype(np.float32)
    found = zip(np.ravel(numbers).tolist(), corners, strict=True)
    return [
        (int(number), _refined(grey, np.asarray(each, np.float64).reshape(4, 2)))
        for number, each in found
    ]


def _refined(grey: NDArray[np.float32], corners: Array) -> Array:
    """Return the corners (4, 2) where lines through the middle of the black square's edges meet.

    Detectors find corners too far inside: a blurred corner is brighter than a blurred edge. At half
    the step from black to white an edge keeps its place, however blurred it is.
    """
    for _ in range(_ROUNDS):
        lines = []
        middle = corners.mean(axis=0)
        for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            along = end - start
            out = np.array([along[1], -along[0]]) / np.linalg.norm(along)
            out *= np.sign(out @ (start - middle))
            reach = np.linalg.norm(along) / _MODULES / 2 * np.linspace(-1.0, 1.0, _PROFILE)
            points = start + np.linspace(0.1, 0.9, _SAMPLES)[:, None] * along
            at = (points[:, None] + reach[:, None] * out).astype(np.float32)
            levels = cv2.remap(grey, at[..., 0], at[..., 1], cv2.INTER_LINEAR)
            # The area under the step gives its place: bright levels begin there.
            dark, bright = levels[:, :1], levels[:, -1:]
            filled = ((levels - dark) / np.maximum(bright - dark, 1.0)).mean(axis=1)
            shift = reach[-1] - 2.0 * reach[-1] * filled.clip(0.0, 1.0)
            centre = (start + end) / 2 + np.median(shift) * out
            lines.append((centre, along + _slope(shift) * out))
        corners = np.array([_crossing(lines[k - 1], lines[k]) for k in range(4)])
    return corners


def _slope(shift: Array) -> float:
    """Return how much further out a side's end lies than its start, by least squares."""
    place = np.linspace(0.1, 0.9, len(shift)) - 0.5
    return float(place @ (shift - shift.mean()) / (place @ place))


def _crossing(one: tuple[Array, Array], two: tuple[Array, Array]) -> Array:
    """Return the point (2,) where two lines, each a point and a direction, meet."""
    (p, u), (q, v) = one, two
    cross = u[0] * v[1] - u[1] * v[0]
    return np.asarray(p + u * ((q[0] - p[0]) * v[1] - (q[1] - p[1]) * v[0]) / cross)


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
