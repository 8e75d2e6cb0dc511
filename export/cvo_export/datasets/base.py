"""The common form of all data sets: sequences of images with a camera pose each."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cvo_edge.camera import Camera, Distortion
from cvo_edge.errors import SourceError, UsageError
from cvo_edge.input.preprocess import halved
from cvo_edge.pose import about
from cvo_edge.trajectories.trajectory import Skipped
from cvo_edge.vocabulary import Decode

Image = NDArray[np.uint8]

# A place whose middle is further than this from zero gets an origin of its own, of round numbers.
_FAR_M, _ROUND_M = 1000.0, 100


class Intrinsics(NamedTuple):
    """A pinhole camera: focal lengths and principal point, all in pixels of the full image."""

    fx: float
    fy: float
    cx: float
    cy: float

    @property
    def possible(self) -> bool:
        """Whether all numbers are finite and the focal lengths positive."""
        return bool(np.isfinite(self).all()) and self.fx > 0.0 and self.fy > 0.0

    def checked(self, where: str) -> Intrinsics:
        """Return the camera if it is possible; raises SourceError, which begins with ``where``."""
        if not self.possible:
            raise SourceError(
                f"{where}: expected finite intrinsics with positive focal lengths, found "
                f"{list(self)}"
            )
        return self

    def scaled(self, factor: float) -> Intrinsics:
        """Return the same camera for images ``factor`` times as large."""
        return Intrinsics(*(factor * value for value in self))


class Lens(NamedTuple):
    """Lens distortion: its model and coefficients, see ``cvo_edge.camera.Camera``."""

    distortion: Distortion = "none"
    coefficients: tuple[float, ...] = ()


NO_DISTORTION = Lens()


@dataclass(frozen=True)
class PoseDataset:
    """Images with known camera poses, grouped in sequences (one continuous recording each).

    Attributes
    ----------
    name
        Name for reports and provenance; never a path.
    poses
        Shape (n, 7), float64: tx ty tz in metres, then the unit quaternion qx qy qz qw of
        ``T_world_camera`` (OpenCV camera: x right, y down, z forward), frame by frame.
    sequence
        Shape (n,), integer: index into ``sequence_names``; frames of one sequence are contiguous
        and in time order.
    sequence_names
        Name of each sequence.
    frame_names
        Name of each frame, unique in the data set, e.g. ``seq-01/frame-000007``.
    read_image
        Maps a frame number to an image, shape (height, width, 3), uint8, BGR. Raises
        ``SourceError`` if the image cannot be read.
    read_half
        As ``read_image``, decoded at half size; raises ``SourceError`` for anything but a JPEG.
        None if the data set has no image files.
    read_whole
        The former ``read_image`` of a data set that is read at half size, else None.
    image_size
        Maps a frame number to height and width of its image, from its header alone, or to None if
        it has none; None if the data set cannot tell sizes.
    intrinsics
        The camera, or None if the data set does not state it.
    lens
        The camera's lens distortion, which the images still have.
    own_train, own_test
        Sequence indices of the data set's own train and test lists; empty if it has no lists.
    skipped
        Number of frames that the reader left out, by reason.
    left_out
        Number of images beside the frames that show no colour, e.g. depth, by reason.
    stamps_ns
        Shape (n,), int64: when each frame was taken, nanoseconds; None if that is not known.
    chosen
        What the reader chose in files that hold several things, e.g. topics of a bag.
    """

    name: str
    poses: NDArray[np.float64]
    sequence: NDArray[np.int64]
    sequence_names: tuple[str, ...]
    frame_names: tuple[str, ...]
    read_image: Callable[[int], NDArray[np.uint8]]
    read_half: Callable[[int], NDArray[np.uint8]] | None = None
    read_whole: Callable[[int], NDArray[np.uint8]] | None = None
    image_size: Callable[[int], tuple[int, int] | None] | None = None
    intrinsics: Intrinsics | None = None
    lens: Lens = NO_DISTORTION
    own_train: frozenset[int] = frozenset()
    own_test: frozenset[int] = frozenset()
    skipped: Mapping[str, int] = field(default_factory=dict)
    left_out: Mapping[str, int] = field(default_factory=dict)
    stamps_ns: NDArray[np.int64] | None = None
    chosen: str = ""

    def __len__(self) -> int:
        return len(self.poses)

    @property
    def origin_m(self) -> tuple[float, float, float] | None:
        """The position that a network of this place computes about; None if it is the world's own.

        None if the median position is within a kilometre of the world's origin. Otherwise that
        median, rounded, because float32 resolves 5e6 m, e.g. a UTM northing, to half a metre.
        """
        middle = np.median(self.poses[:, :3], axis=0)
        if np.linalg.norm(middle) <= _FAR_M:
            return None
        x, y, z = (float(_ROUND_M * round(value / _ROUND_M)) for value in middle.tolist())
        return x, y, z

    @property
    def local_poses(self) -> NDArray[np.float64]:
        """Poses (n, 7) whose positions are relative to ``origin_m``."""
        return about(self.poses, self.origin_m)

    def camera(self) -> Camera | None:
        """Return the camera with its image size and lens, or None if it is not stated.

        Raises SourceError if the first image cannot be read.
        """
        if self.intrinsics is None:
            return None
        height, width = (self.read_whole or self.read_image)(0).shape[:2]
        return Camera(
            width=width,
            height=height,
            **self.intrinsics._asdict(),
            distortion=self.lens.distortion,
            coefficients=self.lens.coefficients,
        )

    def decoded(self, decode: Decode) -> PoseDataset:
        """Return the data set with its images read as a bundle of this ``decode`` reads them.

        Raises UsageError if its images are no JPEG files, by the first one.
        """
        if decode == "full":
            return self
        if self.read_half is None:
            found = "images without files"
        else:
            try:
                self.read_half(0)
            except SourceError as error:
                found = str(error)
            else:
                return replace(self, read_image=self.read_half, read_whole=self.read_image)
        raise UsageError(
            f"decode: expected JPEG files in {self.name} to decode at half size, found {found}; "
            "use --decode full"
        )

    def read_changed(
        self,
        index: int,
        change: Callable[[Image, np.random.Generator], Image],
        generator: np.random.Generator,
    ) -> Image:
        """Return an image with a change that keeps its size, e.g. noise, as a camera would add it.

        A change that is made before the image is compressed cannot be decoded at half size. The
        half picture is therefore changed as the means of four pixels of the whole one change.
        """
        image = self.read_image(index)
        if self.read_whole is None:
            return change(image, generator)
        whole = self.read_whole(index)
        half = image.shape[:2]
        both = whole, change(whole, generator)
        before, after = (halved(each, *half).astype(np.int16) for each in both)
        return np.clip(image + (after - before), 0, 255).astype(np.uint8)


# Bytes of images that ``remembered`` keeps.
_MOST = 512 * 2**20


def remembered(dataset: PoseDataset) -> PoseDataset:
    """Return the data set with its first images kept in memory once they have been read.

    Publishing reads frames several times: as they are, with harmless changes and with noise.
    """
    kept: dict[int, NDArray[np.uint8]] = {}
    left = _MOST

    def read_image(index: int) -> NDArray[np.uint8]:
        nonlocal left
        if index in kept:
            return kept[index].copy()
        image = dataset.read_image(index)
        if image.nbytes <= left:
            left -= image.nbytes
            kept[index] = image.copy()
        return image

    return replace(dataset, read_image=read_image)


def skipped_text(skipped: Mapping[str, int]) -> str:
    """Return a text with the number of skipped frames by reason: ``skipped 3: invalid pose 3``."""
    return str(skipped if isinstance(skipped, Skipped) else Skipped(skipped))
