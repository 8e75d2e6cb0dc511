"""Which part of a camera's image the model sees, and the camera whose images are its inputs.

A network recognises a place at the scale it has learned. An image of a camera with another focal
length is therefore resized until it has the learned one, then cut or padded to the input's shape;
no pixel of the padding counts.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cvo_edge.camera import LEAST_SIDE, Camera, cell_centres
from cvo_edge.errors import UsageError
from cvo_edge.vocabulary import Crop

Array = NDArray[np.float64]

# Focal lengths that differ by this share at most are the same, and pixels, by this share of the
# input's width.
_SAME = 0.01
# Rows and columns of pixels in which two cameras are compared.
_PROBES = (12, 16)


class Box(NamedTuple):
    """Rows top to bottom and columns left to right, without the last ones."""

    top: int
    bottom: int
    left: int
    right: int

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width."""
        return self.bottom - self.top, self.right - self.left


class View(NamedTuple):
    """The ``part`` of an image that appears at a ``place`` of an input of height and width."""

    part: Box
    place: Box
    height: int
    width: int

    @property
    def enlarged(self) -> float:
        """Pixels of the input per pixel of the image along a side, the larger of both sides."""
        return max(
            place / part for place, part in zip(self.place.shape, self.part.shape, strict=True)
        )

    def camera(self, camera: Camera) -> Camera:
        """Return the camera whose images are the inputs, given the one that takes the images."""
        height, width = self.place.shape
        resized = camera.cropped(*self.part).scaled(width, height)
        top, left = self.place.top, self.place.left
        return resized.cropped(-top, self.height - top, -left, self.width - left)


class SeenCamera(NamedTuple):
    """The camera whose images are the model's inputs.

    Attributes
    ----------
    camera
        Its intrinsics.
    place
        The part of the input that shows its images.
    learned
        Whether its images are those that the learned camera would take.
    """

    camera: Camera
    place: Box
    learned: bool

    @property
    def filled(self) -> float:
        """Share of the input that shows images."""
        height, width = self.place.shape
        return height * width / (self.camera.height * self.camera.width)

    def rays(self, grid: tuple[int, int]) -> Array:
        """Return rays (rows * columns, 2) of cell centres, NaN for cells with other pixels."""
        height, width = self.camera.height, self.camera.width
        rows = _shown(grid[0], height, self.place.top, self.place.bottom)
        columns = _shown(grid[1], width, self.place.left, self.place.right)
        shown = np.outer(rows, columns).reshape(-1, 1)
        return np.where(shown, self.camera.rays(cell_centres(height, width, grid)), np.nan)


def crop_view(image_height: int, image_width: int, height: int, width: int, crop: Crop) -> View:
    """Return the view that fills the input with an image.

    ``none``: the whole image, stretched to the input's shape; ``centre``: the largest centred part
    with the aspect ratio of the input.
    """
    kept_height, kept_width = image_height, image_width
    if crop == "centre":
        kept_height = max(1, min(image_height, image_width * height // width))
        kept_width = max(1, min(image_width, image_height * width // height))
    rows, columns = _centred(kept_height, image_height), _centred(kept_width, image_width)
    return View(Box(*rows, *columns), Box(0, height, 0, width), height, width)


def matched_view(camera: Camera, learned: Camera, crop: Crop) -> View:
    """Return the view that shows a camera's images with the focal lengths of the learned camera.

    ``learned`` is the camera whose images are the inputs that the network has learned. The input is
    padded only if necessary: for nearly the same focal lengths, the image fills it.
    """
    height, width = learned.height, learned.width
    filled = crop_view(camera.height, camera.width, height, width, crop)
    seen = filled.camera(camera)
    if _similar(seen.fx, learned.fx) and _similar(seen.fy, learned.fy):
        return filled
    rows, place_rows = _matched(camera.height, height, learned.fy / camera.fy)
    columns, place_columns = _matched(camera.width, width, learned.fx / camera.fx)
    return View(Box(*rows, *columns), Box(*place_rows, *place_columns), height, width)


def seen_camera(camera: Camera, learned: Camera, crop: Crop) -> SeenCamera:
    """Return what the model sees of a camera; arguments as for ``matched_view``.

    Raises UsageError if that is less of its image than any image may be.
    """
    view = matched_view(camera, learned, crop)
    if min(view.part.shape) < LEAST_SIDE:
        height, width = view.part.shape
        raise UsageError(
            f"camera: expected focal lengths with which the model sees {LEAST_SIDE} pixels a side "
            f"or more, found {width}x{height} pixels with fx {camera.fx:g}, fy {camera.fy:g}"
        )
    seen = view.camera(camera)
    whole = view.place.shape == (learned.height, learned.width)
    return SeenCamera(seen, view.place, whole and _same_rays(seen, learned))


def check_same_view(camera: Camera, own: Camera, learned: Camera, crop: Crop) -> None:
    """Raise UsageError if a camera's images cannot be cut and resized to those of another one.

    A network that regresses the pose has learned one view: all of its input, to a hundredth of its
    width, and as sharp. ``own`` is the camera of its calibration, ``learned`` that of its inputs.
    """
    view = matched_view(camera, learned, crop)
    most = max(1.0, matched_view(own, learned, crop).enlarged)
    if seen_camera(camera, learned, crop).learned and view.enlarged <= (1.0 + _SAME) * most:
        return
    expected, found = (
        f"{each.width}x{each.height} with fx {each.fx:g}, fy {each.fy:g}, cx {each.cx:g}, "
        f"cy {each.cy:g}" + (f", {each.distortion}" if each.coefficients else "")
        for each in (own, camera)
    )
    raise UsageError(
        f"camera: expected one whose images can be cut and resized to those of the bundle's "
        f"camera, {expected}, without enlarging them, found {found}"
    )


def _shown(cells: int, pixels: int, first: int, last: int) -> NDArray[np.bool_]:
    """Return which of the cells along one side lie between two of its pixels' edges."""
    edges = np.linspace(0.0, pixels, cells + 1)
    return np.asarray((edges[:-1] >= first) & (edges[1:] <= last))


def _same_rays(seen: Camera, learned: Camera) -> bool:
    """Whether both see the same, to a share of the input's width, wherever they see anything."""
    pixels = cell_centres(learned.height, learned.width, _PROBES)
    rays = learned.rays(pixels)
    known = np.isfinite(rays).all(axis=1)
    shown = seen.project(np.column_stack([rays[known], np.ones(known.sum())]))
    return bool((np.abs(shown - pixels[known]) <= _SAME * learned.width).all())


def _similar(a: float, b: float) -> bool:
    return abs(a / b - 1.0) <= _SAME


def _centred(length: int, whole: int) -> tuple[int, int]:
    start = (whole - length) // 2
    return start, start + length


def _matched(image: int, whole: int, factor: float) -> tuple[tuple[int, int], tuple[int, int]]:
    """Side of an image and of the input, and pixels of the input per pixel -> part and place."""
    if image * factor > whole:
        return _centred(max(1, round(whole / factor)), image), (0, whole)
    return (0, image), _centred(max(1, round(image * factor)), whole)
