"""Open data sets by name, ``FORMAT:PATH``; each format has its own module."""

from __future__ import annotations

from collections.abc import Callable

from cvo_edge.errors import SourceError, UsageError
from cvo_edge.input.decoding import checked_bits
from cvo_export.datasets.ace import open_ace
from cvo_export.datasets.base import Intrinsics, Lens, PoseDataset
from cvo_export.datasets.colmap import open_colmap
from cvo_export.datasets.euroc import open_euroc
from cvo_export.datasets.frames import BITS
from cvo_export.datasets.kitti import open_kitti
from cvo_export.datasets.rgbd_scenes import open_rgbd_scenes
from cvo_export.datasets.rosbag import open_rosbag
from cvo_export.datasets.scannet import open_scannet
from cvo_export.datasets.seven_scenes import open_seven_scenes
from cvo_export.datasets.synthetic import open_synthetic
from cvo_export.datasets.transforms import open_nerfstudio
from cvo_export.datasets.tum import open_tum
from cvo_export.datasets.tum_vi import open_tum_vi
from cvo_export.datasets.twelve_scenes import open_twelve_scenes

__all__ = ["FORMATS", "Intrinsics", "Lens", "PoseDataset", "open_dataset"]

FORMATS: dict[str, Callable[[str], PoseDataset]] = {
    "7scenes": open_seven_scenes,
    "12scenes": open_twelve_scenes,
    "ace": open_ace,
    "scannet": open_scannet,
    "rgbd-scenes": open_rgbd_scenes,
    "tum": open_tum,
    "kitti": open_kitti,
    "euroc": open_euroc,
    "tum-vi": open_tum_vi,
    "colmap": open_colmap,
    "nerfstudio": open_nerfstudio,
    "rosbag": open_rosbag,
    "synthetic": open_synthetic,
}


def open_dataset(text: str) -> PoseDataset:
    """Open ``FORMAT:PATH``, e.g. ``7scenes:scenes/redkitchen`` or ``synthetic:room``.

    The module of each format documents its paths and poses. ``,bits=12`` at the end says how many
    bits the camera fills in images of 16 bits; the upper eight of them are used.

    Raises
    ------
    UsageError
        The format is unknown.
    SourceError
        The data set cannot be read or has no frame with a pose.
    """
    if not isinstance(text, str):
        raise UsageError(f"data set: expected the text FORMAT:PATH, found {text!r}")
    plain, option, digits = text.rpartition(",bits=")
    stated = bool(option) and digits.isdecimal()
    bits = checked_bits(int(digits)) if stated else 16
    name, colon, path = (plain if stated else text).partition(":")
    if not colon or name not in FORMATS:
        raise UsageError(
            f"data set: expected FORMAT:PATH with FORMAT one of {', '.join(FORMATS)}, "
            f"found {text!r}"
        )
    token = BITS.set(bits)
    try:
        return FORMATS[name](path)
    except OSError as error:
        where = error.filename or path
        raise SourceError(f"{where}: expected a data set; cannot read: {error.strerror}") from None
    finally:
        BITS.reset(token)
