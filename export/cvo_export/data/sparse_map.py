"""A sparse map of a place: points triangulated from keypoints of images with known poses.

It teaches a network the depth of what it sees where no depth camera was used. RootSIFT keypoints
(Lowe 2004; Arandjelovic and Zisserman 2012) are matched between frames with a useful baseline;
matches that contradict the known poses are dropped; chains of matches become tracks, and each track
of at least three views one point (Hartley and Zisserman, chapters 9 and 12).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from cvo_edge import geometry
from cvo_edge.camera import Camera
from cvo_edge.engine.cores import allowed_cores
from cvo_edge.errors import SourceError
from cvo_edge.files import whole_file

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Image = NDArray[np.uint8]

# The lower limit of contrast also fills small and soft images with keypoints.
_KEYPOINTS, _CONTRAST = 700, 0.01
# Other frames that a frame is matched with; their greatest turn, and their distance as shares of
# the median depth: nearer ones give no depth, farther ones no matches.
_PARTNERS = 8
_LARGEST_TURN_RAD = np.deg2rad(25.0)
_BASELINES = (0.03, 0.2)
# Frames matched with any distance, to find the median depth; least angle between their rays.
_SCOUTS = 60
_LEAST_ANGLE_RAD = np.deg2rad(1.5)
# Largest ratio of the distances to the best and the second best descriptor (Lowe 2004, 7.1). Wrong
# matches join tracks of different points, which are then lost.
_RATIO = 0.9
# Errors of matches and points in pixels of an image 640 wide; least views of a point.
_EPIPOLAR_PX, _REPROJECTION_PX, _REFERENCE_WIDTH = 3.0, 4.0, 640
_LEAST_VIEWS = 3


class SparseMap(NamedTuple):
    """Points of a place and where frames observed them.

    Attributes
    ----------
    points
        Shape (m, 3): points in the world frame, metres.
    descriptors
        Shape (m, 128), float32: mean RootSIFT descriptor of each point, unit length.
    frame, point
        Shape (k,): frame and point of each observation.
    depth
        Median depth of the observations, metres.
    error_px
        Median reprojection error in pixels of the images.
    """

    points: Array
    descriptors: NDArray[np.float32]
    frame: Indices
    point: Indices
    depth: float
    error_px: float

    def seen_by(self, frame: int) -> Array:
        """Return the points (n, 3) that a frame observed."""
        return np.asarray(self.points[self.point[self.frame == frame]])


def write_sparse_map(found: SparseMap, path: Path) -> None:
    """Write a map atomically; raises SinkError."""
    with whole_file(path) as stream:
        np.savez(stream, **found._asdict())


def read_sparse_map(path: Path) -> SparseMap | None:
    """Read a map that ``write_sparse_map`` wrote; None if there is none, or it is incomplete."""
    try:
        with path.open("rb") as stream, np.load(stream) as stored:
            found = SparseMap(**stored)
        return found._replace(depth=float(found.depth), error_px=float(found.error_px))
    except MemoryError:
        raise
    # numpy and zipfile fail in a dozen ways on a file that holds anything else.
    except Exception:  # noqa: BLE001
        return None


class Keypoints(NamedTuple):
    """Rays (n, 2) of a frame's keypoints and their RootSIFT descriptors (n, 128), unit length."""

    rays: Array
    descriptors: NDArray[np.float32]


def keypoints(image: Image, camera: Camera) -> Keypoints:
    """Find the keypoints of an image (height, width, 3), BGR, of any size of this camera."""
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    found, descriptors = cv2.SIFT.create(_KEYPOINTS, contrastThreshold=_CONTRAST).detectAndCompute(
        grey, None
    )
    if descriptors is None:
        return Keypoints(np.empty((0, 2)), np.empty((0, 128), np.float32))
    height, width = grey.shape
    rays = camera.scaled(width, height).rays([point.pt for point in found[:_KEYPOINTS]])
    total = descriptors[:_KEYPOINTS].sum(axis=1, keepdims=True)
    root = np.sqrt(descriptors[:_KEYPOINTS] / np.maximum(total, 1e-9)).astype(np.float32)
    inside = np.isfinite(rays).all(axis=1)
    return Keypoints(rays[inside], root[inside])


def sparse_map(
    read_image: Callable[[int], Image],
    poses: Array,
    camera: Camera,
    seed: int,
    progress: Callable[[int, int], None],
) -> SparseMap:
    """Triangulate a map from frames with poses (n, 7).

    ``read_image`` maps a frame's row to its image; ``progress`` is told (done, total) steps.

    Raises SourceError if no point has three consistent views: the camera does not move, the images
    have no texture, or poses and intrinsics contradict the images.
    """
    n = len(poses)
    total = 2 * n

    def read(row: int) -> Keypoints:
        found = keypoints(read_image(row), camera)
        progress(row + 1, total)
        return found

    with ThreadPoolExecutor(max_workers=allowed_cores()) as pool:
        frames = _Frames(poses, camera, list(pool.map(read, range(n))))
        generator = np.random.default_rng(seed)
        scouts = np.unique(np.linspace(0, n - 1, _SCOUTS).astype(int))
        tried = list(pool.map(frames.matches, frames.pairs(scouts, (0.0, np.inf), generator)))
        depth = frames.median_depth(tried)
        baselines = (_BASELINES[0] * depth, _BASELINES[1] * depth)
        pairs = frames.pairs(np.arange(n), baselines, generator)
        links = []
        for done, found in enumerate(pool.map(frames.matches, pairs), start=1):
            links.append(found)
            progress(n + done * n // len(pairs), total)
    return frames.points(np.concatenate([*links, np.empty((0, 2), np.int64)]))


class _Frames:
    """Frames with poses and keypoints; keypoints of all frames are numbered consecutively."""

    def __init__(self, poses: Array, camera: Camera, keypoints: list[Keypoints]) -> None:
        self.keypoints = keypoints
        # Number of each frame's first keypoint, and of all keypoints.
        self.offsets = np.cumsum([0, *(len(each.rays) for each in keypoints)])
        self.R = geometry.quaternion_to_matrix(poses[:, 3:])
        self.t = poses[:, :3]
        # Normalised coordinates per pixel of an image of the reference width.
        self.pixel = camera.width / _REFERENCE_WIDTH / np.sqrt(camera.fx * camera.fy)
        self.own_pixel = 1.0 / np.sqrt(camera.fx * camera.fy)

    def pairs(
        self, rows: Indices, baselines: tuple[float, float], generator: np.random.Generator
    ) -> list[tuple[int, int]]:
        """Draw partners of these frames with a distance in ``baselines`` and a small turn."""
        found = set()
        for row in rows.tolist():
            distance = np.linalg.norm(self.t - self.t[row], axis=1)
            cosine = (np.einsum("nij,ij->n", self.R, self.R[row]) - 1.0) / 2.0
            turn = np.arccos(np.clip(cosine, -1.0, 1.0))
            low, high = baselines
            near = (distance > low) & (distance <= high) & (turn <= _LARGEST_TURN_RAD)
            partners = np.flatnonzero(near)
            drawn = generator.choice(partners, min(_PARTNERS, partners.size), replace=False)
            found |= {(min(row, other), max(row, other)) for other in drawn.tolist()}
        return sorted(found)

    def matches(self, pair: tuple[int, int]) -> Indices:
        """Return the matched keypoints (k, 2) of two frames that agree with their poses."""
        one, two = pair
        a, b = self.keypoints[one], self.keypoints[two]
        if not len(a.rays) or not len(b.rays):
            return np.empty((0, 2), np.int64)
        likeness = a.descriptors @ b.descriptors.T
        forward, backward = likeness.argmax(axis=1), likeness.argmax(axis=0)
        every = np.arange(len(forward))
        best = likeness[every, forward]
        likeness[every, forward] = -1.0
        # Distances of unit vectors: |a - b|^2 = 2 - 2 a.b.
        distinct = 1.0 - best < _RATIO**2 * (1.0 - likeness.max(axis=1))
        rows = np.flatnonzero((backward[forward] == every) & distinct)
        columns = forward[rows]
        error = self._epipolar(one, two, a.rays[rows], b.rays[columns])
        good = error < _EPIPOLAR_PX * self.pixel
        kept = rows[good] + self.offsets[one], columns[good] + self.offsets[two]
        return np.stack(kept, axis=1)

    def _epipolar(self, one: int, two: int, x: Array, y: Array) -> Array:
        """Rays (k, 2) in two frames -> Sampson error (k,) (Hartley and Zisserman, eq. 11.9)."""
        R = self.R[two].T @ self.R[one]
        a, b, c = self.R[two].T @ (self.t[one] - self.t[two])
        E = np.array([[0.0, -c, b], [c, 0.0, -a], [-b, a, 0.0]]) @ R
        first = np.column_stack([x, np.ones(len(x))])
        second = np.column_stack([y, np.ones(len(y))])
        in_second, in_first = first @ E.T, second @ E
        slope = np.square(in_second[:, :2]).sum(axis=1) + np.square(in_first[:, :2]).sum(axis=1)
        product = (second * in_second).sum(axis=1)
        return np.asarray(np.abs(product) / np.sqrt(np.maximum(slope, 1e-300)))

    def median_depth(self, matches: Sequence[Indices]) -> float:
        """Return the median depth of matched keypoints, each pair triangulated alone."""
        links = np.concatenate([*matches, np.empty((0, 2), np.int64)])
        frame, rays = self._numbered()
        point = np.tile(np.arange(len(links)), 2)
        observed = links.T.ravel()
        points = self._triangulated(point, frame[observed], rays[observed])
        directions = self._directions(frame[observed], rays[observed]).reshape(2, -1, 3)
        angle = np.arccos(np.clip((directions[0] * directions[1]).sum(axis=1), -1.0, 1.0))
        first = frame[links[:, 0]]
        depth = np.einsum("ni,ni->n", self.R[first, :, 2], points - self.t[first])
        depth = depth[(angle > _LEAST_ANGLE_RAD) & (depth > 0.0)]
        if not depth.size:
            raise _refusal(0)
        return float(np.median(depth))

    def points(self, links: Indices) -> SparseMap:
        """Join matched keypoints (k, 2) to tracks and triangulate them."""
        frame, rays = self._numbered()
        count = len(frame)
        graph = coo_matrix((np.ones(len(links)), (links[:, 0], links[:, 1])), (count, count))
        _, track = connected_components(graph, directed=False)
        # A wrong match can join two keypoints of one frame: keep the first of them, and let the
        # reprojection error decide.
        _, kept = np.unique(track.astype(np.int64) * len(self.t) + frame, return_index=True)
        # Each round drops observations, so it ends.
        while True:
            sizes = np.bincount(track[kept], minlength=track.max() + 1)
            kept = kept[sizes[track[kept]] >= _LEAST_VIEWS]
            if not kept.size:
                raise _refusal(len(links))
            _, point = np.unique(track[kept], return_inverse=True)
            points = self._triangulated(point, frame[kept], rays[kept])
            error = self._reprojection(points[point], frame[kept], rays[kept])
            good = error < _REPROJECTION_PX * self.pixel
            if good.all():
                break
            kept = kept[good]
        descriptors = np.concatenate([each.descriptors for each in self.keypoints])[kept]
        mean = np.zeros((len(points), 128), np.float32)
        np.add.at(mean, point, descriptors)
        mean /= np.linalg.norm(mean, axis=1, keepdims=True)
        error_px = float(np.median(error) / self.own_pixel)
        seen_from = self.R[frame[kept], :, 2], points[point] - self.t[frame[kept]]
        depth = float(np.median(np.einsum("ni,ni->n", *seen_from)))
        return SparseMap(points, mean, frame[kept], point, depth, error_px)

    def _numbered(self) -> tuple[Indices, Array]:
        """Frame (k,) and ray (k, 2) of every keypoint."""
        frame = np.repeat(np.arange(len(self.t)), np.diff(self.offsets))
        return frame, np.concatenate([each.rays for each in self.keypoints])

    def _directions(self, frame: Indices, rays: Array) -> Array:
        """Unit vectors (k, 3) in the world along rays (k, 2) of frames."""
        ahead = np.column_stack([rays, np.ones(len(rays))])
        turned = np.einsum("nij,nj->ni", self.R[frame], ahead)
        return np.asarray(turned / np.linalg.norm(turned, axis=1, keepdims=True))

    def _triangulated(self, point: Indices, frame: Indices, rays: Array) -> Array:
        """Observations (k,) of points -> points (m, 3): nearest to all rays, then refined."""
        d = self._directions(frame, rays)
        across = np.eye(3) - d[:, :, np.newaxis] * d[:, np.newaxis, :]
        points = _solved(point, across, np.einsum("nij,nj->ni", across, self.t[frame]))
        tolerance = np.square(_REPROJECTION_PX * self.pixel)
        for _ in range(4):
            # Robust Gauss-Newton steps on the reprojection error, with Cauchy weights.
            Y = np.einsum("nij,ni->nj", self.R[frame], points[point] - self.t[frame])
            depth = np.maximum(Y[:, 2], 1e-6)
            image = Y[:, :2] / depth[:, np.newaxis]
            error = rays - image
            J = np.zeros((len(frame), 2, 3))
            J[:, 0, 0] = J[:, 1, 1] = 1.0 / depth
            J[:, :, 2] = -image / depth[:, np.newaxis]
            J = np.einsum("nab,ncb->nac", J, self.R[frame])
            weight = 1.0 / (1.0 + np.square(error).sum(axis=1) / tolerance)
            normal = np.einsum("n,nab,nac->nbc", weight, J, J)
            points = points + _solved(point, normal, np.einsum("n,nab,na->nb", weight, J, error))
        return points

    def _reprojection(self, points: Array, frame: Indices, rays: Array) -> Array:
        """Reprojection error (k,) of points (k, 3), normalised; infinite behind the camera."""
        Y = np.einsum("nij,ni->nj", self.R[frame], points - self.t[frame])
        depth = np.where(Y[:, 2] > 0.0, Y[:, 2], np.nan)
        error = np.linalg.norm(Y[:, :2] / depth[:, np.newaxis] - rays, axis=1)
        return np.asarray(np.nan_to_num(error, nan=np.inf))


def _solved(point: Indices, normal: Array, right: Array) -> Array:
    """Sum 3x3 systems (k, 3, 3) and right sides (k, 3) by point and solve them, (m, 3)."""
    count = int(point.max(initial=-1)) + 1
    H, g = np.zeros((count, 3, 3)), np.zeros((count, 3))
    np.add.at(H, point, normal)
    np.add.at(g, point, right)
    # Parallel rays do not fix the depth.
    damping = 1e-6 * np.trace(H, axis1=1, axis2=2) + 1e-12
    H += damping[:, np.newaxis, np.newaxis] * np.eye(3)
    return np.asarray(np.linalg.solve(H, g[..., np.newaxis])[..., 0])


def _refusal(matches: int) -> SourceError:
    return SourceError(
        f"map: expected points seen from {_LEAST_VIEWS} places, found {matches} matches and no "
        "point; the camera must move, see texture, and have correct intrinsics and poses"
    )
