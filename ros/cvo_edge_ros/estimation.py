"""From messages with images to messages with poses, without rclpy."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from time import perf_counter
from typing import Any, NamedTuple

import msgspec

from cvo_edge.camera import Camera, checked_camera
from cvo_edge.engine.model_cache import ModelCache
from cvo_edge.errors import UsageError
from cvo_edge.input.clock import SYSTEM_CLOCK, Clock
from cvo_edge.input.frame import Frame
from cvo_edge.input.ros_images import lens_of, message_image, pinhole_of
from cvo_edge.odometer import Odometer
from cvo_edge.output.messages import TRANSFORM, Message, Placement, ros_messages
from cvo_edge.output.records import header_of
from cvo_edge.programs.placing import Placing
from cvo_edge.vocabulary import Decode, Scope

# Parameters of the node and their defaults; an empty text and a zero stand for none.
PARAMETERS: dict[str, str | float | bool] = {
    "bundle": "",
    "public_key": "",
    "image_topic": "image_raw",
    "camera_info_topic": "",
    "confidence": 0.9,
    "scope": "marginal",
    "base": "",
    "map": "",
    "frame_id": "",
    "child_frame_id": "",
    "unknown_variance": 0.0,
    "publish_tf": False,
    "expect_motion": False,
}
NO_CAMERA_INFO = "none"


class Settings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The parameters, see ``config/params.yaml``."""

    bundle: str
    public_key: str
    image_topic: str
    camera_info_topic: str
    confidence: float
    scope: Scope
    base: str
    map: str
    frame_id: str
    child_frame_id: str
    unknown_variance: float
    publish_tf: bool
    expect_motion: bool

    @property
    def compressed(self) -> bool:
        """Whether the images are ``CompressedImage``."""
        return self.image_topic.endswith("/compressed")

    @property
    def info_topic(self) -> str | None:
        """The topic of ``CameraInfo``: by default beside the images; None: none is waited for."""
        if self.camera_info_topic == NO_CAMERA_INFO:
            return None
        base = self.image_topic.removesuffix("/compressed").rpartition("/")[0]
        return self.camera_info_topic or (f"{base}/camera_info" if base else "camera_info")


def settings_of(values: Mapping[str, Any]) -> Settings:
    """Check the node's parameters; raises UsageError."""
    try:
        found = msgspec.convert(dict(values), Settings)
    except msgspec.ValidationError as error:
        raise UsageError(f"parameters: {error}") from None
    if not found.bundle:
        raise UsageError("bundle: expected the folder of a bundle, found nothing")
    return found


def camera_of(info: Any, image_topic: str) -> Camera:
    """Return the camera of a ``CameraInfo``; raises UsageError for one that cannot be used.

    Images whose topic's last name has ``rect`` in it are rectified: their camera is P.
    """
    instead = f"set camera_info_topic to {NO_CAMERA_INFO} for the bundle's own camera"
    rectified = "rect" in image_topic.removesuffix("/compressed").rpartition("/")[2]
    pinhole = pinhole_of(info, rectified=rectified)
    if pinhole is None:
        raise UsageError(f"camera_info: expected a calibrated camera, found zeros; {instead}")
    region = info.roi
    if max(info.binning_x, info.binning_y) > 1 or region.width not in (0, info.width):
        raise UsageError(
            f"camera_info: expected whole images without binning, found binning "
            f"{info.binning_x}x{info.binning_y} and a region {region.width}x{region.height}"
        )
    lens = ("none", ()) if rectified else lens_of(info)
    if lens is None:
        raise UsageError(
            f"camera_info: expected the lens model plumb_bob, rational_polynomial or equidistant, "
            f"found {info.distortion_model} with {len(info.d)} numbers; use rectified images"
        )
    numbers = dict(zip(("fx", "fy", "cx", "cy"), pinhole.tolist(), strict=True))
    try:
        size = {"width": int(info.width), "height": int(info.height)}
        return checked_camera(Camera(**size, **numbers, distortion=lens[0], coefficients=lens[1]))
    except ValueError as error:
        raise UsageError(f"camera_info: {error}") from None


def frame_of(
    message: Any,
    dropped: int,
    now_ns: int,
    clock: Clock = SYSTEM_CLOCK,
    decode: Decode = "full",
) -> Frame:
    """Return the frame of a message with an image.

    ``now_ns``: the node's clock. A frame is as old as its stamp says; one without a stamp is
    stamped now. Raises UsageError for an uncompressed image that is to be decoded at half size.
    """
    arrived_s, start = clock.now_s(), perf_counter()
    stamp = message.header.stamp
    stamp_ns = 1_000_000_000 * int(stamp.sec) + int(stamp.nanosec) or now_ns
    image = message_image(message, decode=decode)
    return Frame(
        image,
        stamp_ns,
        message.header.frame_id,
        1e3 * (perf_counter() - start),
        queued_ms=max(0.0, 1e-6 * (now_ns - stamp_ns)),
        arrived_s=arrived_s,
        skipped=dropped,
    )


class Answer(NamedTuple):
    """The messages of one frame, and what is to be logged of it: a status that changed."""

    messages: list[Message]
    news: str | None


def answers(
    settings: Settings,
    camera: Camera | None,
    arrivals: Iterable[tuple[Any, int]],
    now_ns: Callable[[], int],
) -> Iterator[Answer]:
    """Yield the messages of each frame, as ``cvo_edge.output.messages`` decides.

    Raises the errors of ``Odometer.load``, and UsageError for settings that it refuses.
    """
    with Odometer.load(
        settings.bundle,
        mode="live",
        confidence=settings.confidence,
        scope=settings.scope,
        camera=camera,
        cache=ModelCache.default(),
        public_key=settings.public_key or None,
    ) as odometer:
        calibration = odometer.calibration
        header = header_of(calibration, odometer.chart, odometer.confidence, settings.scope)
        placing = Placing(
            settings.base or None,
            settings.map or None,
            settings.frame_id or None,
            settings.child_frame_id or None,
            settings.unknown_variance or None,
        )
        placement = placing.placement(header) or Placement.of(header)
        decode = calibration.preprocess.decode
        frames = (
            frame_of(message, dropped, now_ns(), decode=decode) for message, dropped in arrivals
        )
        moving = True if settings.expect_motion else None
        before = None
        for estimate in odometer.stream(frames, moving=moving):
            found = list(ros_messages(estimate, placement, header))
            if not settings.publish_tf:
                found = [each for each in found if each.type != TRANSFORM]
            said = estimate.status, estimate.reasons
            news = None if said == before else " ".join((said[0].value, *said[1]))
            before = said
            yield Answer(found, news)
