"""Images and cameras of ROS messages: ``sensor_msgs/Image``, ``CompressedImage``, ``CameraInfo``.

Messages may come from a bag or from a subscription: fields are read by name, and data may be any
buffer of bytes.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from cvo_edge.camera import Distortion
from cvo_edge.input.decoding import MAX_PIXELS, decode_image, image_size, upper_eight
from cvo_edge.input.half import not_half
from cvo_edge.vocabulary import Decode

Image = NDArray[np.uint8]
Array = NDArray[np.float64]


class Form(NamedTuple):
    """Bytes of a number, numbers of a pixel, and OpenCV's conversion to BGR."""

    depth: int
    channels: int
    conversion: int | None


# Names of sensor_msgs/image_encodings.h. OpenCV names a Bayer pattern by its first two pixels.
FORMS: dict[str, Form] = {
    "bgr8": Form(1, 3, None),
    "8UC3": Form(1, 3, None),
    "rgb8": Form(1, 3, cv2.COLOR_RGB2BGR),
    "bgra8": Form(1, 4, cv2.COLOR_BGRA2BGR),
    "rgba8": Form(1, 4, cv2.COLOR_RGBA2BGR),
    "bgr16": Form(2, 3, None),
    "rgb16": Form(2, 3, cv2.COLOR_RGB2BGR),
    "mono8": Form(1, 1, cv2.COLOR_GRAY2BGR),
    "8UC1": Form(1, 1, cv2.COLOR_GRAY2BGR),
    "mono16": Form(2, 1, cv2.COLOR_GRAY2BGR),
    # Older names, then newer ones.
    "yuv422": Form(1, 2, cv2.COLOR_YUV2BGR_UYVY),
    "yuv422_yuy2": Form(1, 2, cv2.COLOR_YUV2BGR_YUY2),
    "uyvy": Form(1, 2, cv2.COLOR_YUV2BGR_UYVY),
    "yuyv": Form(1, 2, cv2.COLOR_YUV2BGR_YUY2),
} | {
    f"bayer_{pattern}{8 * depth}": Form(depth, 1, conversion)
    for pattern, conversion in (
        ("rggb", cv2.COLOR_BayerRGGB2BGR),
        ("bggr", cv2.COLOR_BayerBGGR2BGR),
        ("gbrg", cv2.COLOR_BayerGBRG2BGR),
        ("grbg", cv2.COLOR_BayerGRBG2BGR),
    )
    for depth in (1, 2)
}
# Depth is 16UC1 or 32FC1; compressed, it would pass for a grey image.
_DEPTH = ("16UC1", "32FC1", "16SC1")
_MODELS: dict[str, Distortion] = {
    "plumb_bob": "radial_tangential",
    "rational_polynomial": "radial_tangential",
    "equidistant": "equidistant",
    "fisheye": "equidistant",
}


def message_size(message: Any) -> tuple[int, int] | None:
    """Return height and width of the image in a message, or None if it cannot be decoded."""
    content = np.frombuffer(message.data, np.uint8)
    if not hasattr(message, "encoding"):
        depth = str(getattr(message, "format", "")).startswith(_DEPTH)
        return None if depth else image_size(content.tobytes())
    form = FORMS.get(message.encoding)
    height, width, step = int(message.height), int(message.width), int(message.step)
    if form is None or not 0 < height * width <= MAX_PIXELS:
        return None
    whole = step >= width * form.channels * form.depth and content.size >= step * height
    return (height, width) if whole else None


def message_image(message: Any, bits: int = 16, decode: Decode = "full") -> Image | None:
    """Return the image in a message, (height, width, 3) BGR; None if it cannot be decoded.

    16 bits keep the upper eight of ``bits``, and ``half`` decodes at half size, as in
    ``decode_image``. Raises UsageError for an uncompressed image that is to be halved.
    """
    size = message_size(message)
    if size is None:
        return None
    content = np.frombuffer(message.data, np.uint8)
    if not hasattr(message, "encoding"):
        return decode_image(content.tobytes(), bits, decode)
    if decode == "half":
        raise not_half("an uncompressed image")
    form, (height, width) = FORMS[message.encoding], size
    rows = content[: message.step * height].reshape(height, message.step)
    pixels = np.ascontiguousarray(rows[:, : width * form.channels * form.depth])
    if form.depth == 2:
        wide = pixels.view(">u2" if message.is_bigendian else "<u2")
        pixels = upper_eight(wide, bits)
    if form.channels > 1:
        pixels = pixels.reshape(height, width, form.channels)
    if form.conversion is None:
        return pixels
    try:
        return np.asarray(cv2.cvtColor(pixels, form.conversion), np.uint8)
    except cv2.error:
        return None


def pinhole_of(info: Any, *, rectified: bool) -> Array | None:
    """Return fx fy cx cy of a camera, of its rectified images from P; None: not calibrated."""
    values = matrix(info, "p")[[0, 5, 2, 6]] if rectified else matrix(info, "k")[[0, 4, 2, 5]]
    return values if values[:2].any() else None


def lens_of(info: Any) -> tuple[Distortion, tuple[float, ...]] | None:
    """Return lens model and coefficients of a camera; None: a model that is not known."""
    D = matrix(info, "d")
    if not D.any():
        return "none", ()
    model = _MODELS.get(info.distortion_model)
    count = 4 if model == "equidistant" else 5 if D.size <= 5 else 8
    if model is None or D[count:].any() or not np.isfinite(D).all():
        return None
    return model, tuple(np.pad(D[:count], (0, max(0, count - D.size))).tolist())


def matrix(info: Any, name: str) -> Array:
    """Return numbers of a camera by their name; ROS 1 has capital letters."""
    return np.asarray(getattr(info, name, getattr(info, name.upper(), ())), dtype=np.float64)
