"""The image sizes of a data set: a bundle is made for images of one size."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

from cvo_edge.camera import LEAST_SIDE, Camera
from cvo_edge.errors import SourceError
from cvo_export.datasets.base import Intrinsics, Lens, PoseDataset

Size = tuple[int, int]


def image_sizes(dataset: PoseDataset) -> Counter[Size]:
    """Count the frames of each image size (width, height), without unreadable images.

    Reads the files' headers. A data set that cannot tell sizes is taken to have that of its first
    image, for which SourceError is raised if it cannot be read.
    """
    if dataset.image_size is None:
        height, width = dataset.read_image(0).shape[:2]
        return Counter({(width, height): len(dataset)})
    found = (dataset.image_size(index) for index in range(len(dataset)))
    return Counter((size[1], size[0]) for size in found if size is not None)


def one_size(dataset: PoseDataset) -> Size:
    """Return width and height of all images of a data set.

    Raises SourceError if they have several sizes, or one too small, or if an image is damaged.
    """
    sizes = image_sizes(dataset)
    if len(sizes) != 1:
        raise SourceError(
            f"{dataset.name}: expected images of one size, found {sizes_text(sizes) or 'none'}"
            + ("; leave the others out, or resize those of the same camera" if sizes else "")
        )
    (size,) = sizes
    if min(size) < LEAST_SIDE:
        raise SourceError(
            f"{dataset.name}: expected images of at least {LEAST_SIDE} px per side, found "
            f"{sizes_text(sizes)}"
        )
    if dataset.image_size is not None and (damaged := len(dataset) - sizes.total()):
        names = (n for i, n in enumerate(dataset.frame_names) if dataset.image_size(i) is None)
        raise SourceError(
            f"{dataset.name}: expected readable images, found {damaged} damaged of {len(dataset)}, "
            f"the first {next(names, '')}; delete them"
        )
    return size


def with_camera(dataset: PoseDataset, where: str, camera: Camera) -> PoseDataset:
    """Return the data set with a camera, scaled to the size of its images.

    Raises SourceError, which begins with ``where``, if the images have another shape than the
    camera, or if the first image cannot be read.
    """
    height, width = dataset.read_image(0).shape[:2]
    if abs(width * camera.height - height * camera.width) > max(camera.width, camera.height):
        raise SourceError(
            f"{where}: expected images of {camera.width}x{camera.height} or of that shape, as "
            f"stated there, found {width}x{height}; resize them, or correct the numbers"
        )
    camera = camera.scaled(width, height)
    return replace(
        dataset,
        intrinsics=Intrinsics(camera.fx, camera.fy, camera.cx, camera.cy),
        lens=Lens(camera.distortion, camera.coefficients),
    )


def sizes_text(sizes: Counter[Size]) -> str:
    """Return the sizes and the number of frames of each, the most frequent first."""
    return ", ".join(f"{w}x{h} ({count})" for (w, h), count in sizes.most_common())
