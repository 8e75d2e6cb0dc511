"""The map as arrays in the project's conventions, and cameras in COLMAP's."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cvo_edge import geometry
from cvo_edge.camera import Camera, checked_camera
from cvo_edge.errors import SinkError, UsageError
from cvo_export.datasets.colmap_cameras import HALF_PIXEL, camera_of
from cvo_export.reconstruct.similarity import Similarity
from cvo_export.reconstruct.stages import remove

Array = NDArray[np.float64]

_COUNTS = (4, 8, 9, 12)


def read_intrinsics(text: str, width: int, height: int) -> Camera:
    """Return the camera ``fx,fy,cx,cy[,k1,k2,p1,p2[,k3[,k4,k5,k6]]]``; raises UsageError."""
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) not in _COUNTS or not np.isfinite(values).all():
        raise UsageError(
            "intrinsics: expected fx,fy,cx,cy in pixels, or with k1,k2,p1,p2[,k3[,k4,k5,k6]] as in "
            f"OpenCV, found {text}"
        )
    fx, fy, cx, cy, *lens = values
    try:
        camera = Camera(
            width=width,
            height=height,
            fx=fx,
            fy=fy,
            cx=cx,
            cy=cy,
            distortion="radial_tangential" if lens else "none",
            coefficients=tuple(lens),
        )
    except ValueError as error:
        raise UsageError(f"intrinsics: {error}") from None
    return checked_camera(camera)


def colmap_camera(camera: Camera) -> tuple[str, list[float]]:
    """Return COLMAP's model and parameters of a camera; inverse of ``camera_of``."""
    pinhole = [camera.fx, camera.fy, camera.cx + HALF_PIXEL, camera.cy + HALF_PIXEL]
    if camera.distortion == "none":
        return "PINHOLE", pinhole
    if camera.distortion == "equidistant":
        return "OPENCV_FISHEYE", [*pinhole, *camera.coefficients]
    if len(camera.coefficients) == 4:
        return "OPENCV", [*pinhole, *camera.coefficients]
    return "FULL_OPENCV", [*pinhole, *(*camera.coefficients, 0.0, 0.0, 0.0)[:8]]


class Model(NamedTuple):
    """The placed images of a map.

    ``poses`` (n, 7) are ``T_world_camera`` of the images ``names``, sorted; ``cameras`` are theirs.
    ``error_px`` is the mean reprojection error, ``track`` the mean number of images of a point.
    """

    names: tuple[str, ...]
    poses: Array
    cameras: tuple[Camera, ...]
    points: int
    error_px: float
    track: float

    def row(self, name: str) -> int | None:
        """Return the row of an image; None if it has not been placed."""
        return self.names.index(name) if name in self.names else None


def read_model(folder: Path) -> Model:
    """Read a map in COLMAP's binary format."""
    return model_of(_read(folder))


def _read(folder: Path) -> Any:  # noqa: ANN401 - pycolmap is an optional package
    import pycolmap

    return pycolmap.Reconstruction(folder)


def model_of(found: Any) -> Model:  # noqa: ANN401
    """Return the arrays of a ``pycolmap.Reconstruction``."""
    cameras = {
        number: camera_of(
            f"camera {number}",
            camera.model_name,
            (camera.width, camera.height),
            list(map(float, camera.params)),
        )
        for number, camera in found.cameras.items()
    }
    images = sorted(
        (image for image in found.images.values() if image.has_pose), key=lambda image: image.name
    )
    poses = []
    for image in images:
        R = image.cam_from_world().rotation.matrix().T
        poses.append([*image.projection_center(), *geometry.matrix_to_quaternion(R)])
    return Model(
        tuple(image.name for image in images),
        np.array(poses, np.float64).reshape(-1, 7),
        tuple(cameras[image.camera_id] for image in images),
        found.num_points3D(),
        found.compute_mean_reprojection_error(),
        found.compute_mean_track_length(),
    )


def write_transformed(source: Path, target: Path, similarity: Similarity) -> Model:
    """Write a map in another world frame, whole; returns it.

    Raises SinkError if what was written is not what is read, e.g. because the disk is full.
    """
    import pycolmap

    found = _read(source)
    R = geometry.quaternion_to_matrix(similarity.rotation)
    matrix = np.column_stack([similarity.scale * R, similarity.translation])
    found.transform(pycolmap.Sim3d(matrix))
    partial = target.with_name(f"{target.name}.partial")
    remove(partial)
    try:
        partial.mkdir(parents=True)
        found.write_binary(partial)
        again = _read(partial)
        whole = again.num_points3D() == found.num_points3D()
        whole &= again.num_reg_images() == found.num_reg_images()
    except (OSError, RuntimeError, ValueError):
        whole = False
    if not whole:
        remove(partial)
        raise SinkError(
            f"{target}: cannot be written whole; free some space and repeat the command"
        )
    remove(target)
    partial.rename(target)
    return model_of(found)
