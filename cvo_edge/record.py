"""What is written of a frame: one record, with its status and remarks."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Literal

from msgspec import UNSET, Meta, Struct, UnsetType

from cvo_edge.pose import Rotation
from cvo_edge.vocabulary import Scope

SixOrUnbounded = tuple[
    float | None, float | None, float | None, float | None, float | None, float | None
]
BandsOrUnbounded = tuple[tuple[tuple[float | None, float | None], ...], ...]


class Status(StrEnum):
    """Validity of a frame's estimate."""

    OK = "ok"
    DEGRADED = "degraded"
    INVALID = "invalid"


class Reason(StrEnum):
    """All remarks on a frame; the comments give the status that goes with each of them."""

    IMAGE_UNREADABLE = "image_unreadable"  # invalid: the file or stream gave no complete image
    IMAGE_UNSUPPORTED = "image_unsupported"  # invalid: not a 2-D or 3-channel 8- or 16-bit image
    OUTPUT_NOT_FINITE = "output_not_finite"  # invalid: the network gave NaN or infinity
    OUTPUT_ABSURD = "output_absurd"  # invalid: the network gave implausibly large numbers
    POSE_IMPLAUSIBLE = "pose_implausible"  # invalid: outside the bundle's pose limits
    IMAGE_BLACK = "image_black"  # degraded: almost no light, e.g. a lens cap
    IMAGE_SATURATED = "image_saturated"  # degraded: more than half of the image is white
    IMAGE_FLAT = "image_flat"  # degraded: one colour, no contrast
    IMAGE_SIZE_CHANGED = "image_size_changed"  # degraded: not the size of the stream's first frame
    CAMERA_DIFFERS = "camera_differs"  # degraded: the images are not those of the known camera
    IMAGE_TOO_SMALL = "image_too_small"  # degraded: fewer pixels than calibration images and model
    IMAGE_NOT_HALF = "image_not_half"  # degraded: not half the size of the calibration images
    IMAGE_GREY = "image_grey"  # degraded: no colour, unlike the calibration images
    IMAGE_UNFAMILIAR = "image_unfamiliar"  # degraded: does not show the place the network knows
    IMAGE_DEGRADED = "image_degraded"  # degraded: noisier or poorer than any calibrated image
    FRAME_REPEATED = "frame_repeated"  # degraded: the same image came before; it may be frozen
    PICTURE_STILL = "picture_still"  # degraded: the camera moves, as stated, but not its picture
    FRAME_STALE = "frame_stale"  # degraded: the frame waited for more than a second
    STAMP_NOT_LATER = "stamp_not_later"  # degraded: not later than the previous frame's stamp
    STAMP_IMPLAUSIBLE = "stamp_implausible"  # degraded: a stamp before 1970 or after 2262
    BOUNDS_CROSSED = (
        "bounds_crossed"  # ok: a negative correction emptied a set; it is now its midpoint
    )
    PITCH_NEAR_90 = "pitch_near_90"  # ok: |pitch| > 80 deg, roll and yaw are ill-defined
    IMAGE_RESIZED = "image_resized"  # ok: another size than the calibration images; told once


# Far beyond what an alarm may give.
_Novelty = Annotated[float, Meta(ge=-1e15, le=1e15)]


class _Strict(Struct, frozen=True, forbid_unknown_fields=True):
    """Immutable; unknown keys are an error."""


class RecordedPose(_Strict, frozen=True):
    """``t_m``: tx ty tz of the camera in the world, metres; ``q_xyzw``: its rotation, unit."""

    t_m: tuple[float, float, float]
    q_xyzw: tuple[float, float, float, float]


class RecordedRegion(_Strict, frozen=True):
    """The region of all six degrees of freedom, as ``Ellipsoids`` describes it."""

    radius: float
    scale: list[list[float]]
    centres: list[list[float]]


class RecordedInterval(_Strict, frozen=True):
    """The conformal set in the chart ``rotation``, m and rad; None (null) is unbounded.

    ``bands`` holds intervals per DoF for methods whose sets may have gaps. ``region`` is UNSET (no
    key) unless regions were requested, and None if there is no region or it is unbounded.
    """

    confidence: float
    scope: Scope
    rotation: Rotation
    lower: SixOrUnbounded
    upper: SixOrUnbounded
    bounded: bool
    bands: BandsOrUnbounded | None
    region: RecordedRegion | UnsetType | None = UNSET


class Record(_Strict, frozen=True):
    """The output for one frame: one JSON line, one CSV row or one line of the table.

    ``factor`` is UNSET (no key) unless the thresholds adapt to labels; ``novelty`` and ``drift``
    are UNSET if the bundle has no alarm.
    """

    seq: int
    stamp_ns: int | None
    source: str
    status: Status
    reasons: tuple[Reason, ...]
    pose: RecordedPose | None
    interval: RecordedInterval | None
    latency_ms: dict[str, float]
    factor: tuple[float, ...] | UnsetType = UNSET
    novelty: _Novelty | UnsetType | None = UNSET
    drift: Literal["clear", "alarm"] | UnsetType = UNSET
