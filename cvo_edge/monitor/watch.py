"""All checks of one stream, in the order of their reasons in a record."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cvo_edge.bundle.format import Calibration
from cvo_edge.camera_check import LensEstimate
from cvo_edge.engine.observation import Observation, Observer
from cvo_edge.estimate import Drift
from cvo_edge.input.frame import Frame, checked_hint
from cvo_edge.input.frame_checks import Look, StreamChecks
from cvo_edge.monitor.alarm import StreamAlarm, false_alarms
from cvo_edge.record import Reason
from cvo_edge.sets import ConformalSet

_STEEP_PITCH = np.deg2rad(80.0)


class Verdict(NamedTuple):
    """Why a frame has no interval, empty if it has one; the alarm's state and the novelty."""

    doubts: tuple[Reason, ...]
    drift: Drift
    novelty: float | None


def tells_of_the_place(observation: Observation) -> bool:
    """Whether the alarm judges a frame: not if another check of the image explains it."""
    return observation.fault is None and observation.doubt in (None, Reason.IMAGE_UNFAMILIAR)


def _same_picture(look: Look | None, other: Look | None) -> bool:
    if look is None or other is None:
        return False
    return look.size == other.size and np.array_equal(look.digest.hashes, other.digest.hashes)


class StreamWatch:
    """Watches one stream; pass every frame once, in order, to ``picture`` and then to ``judge``.

    Parameters
    ----------
    observer
        The observer of the stream's frames.
    calibration
        That of its bundle.

    Attributes
    ----------
    image
        That of the last frame, as its source gave it.
    """

    def __init__(self, observer: Observer, calibration: Calibration) -> None:
        self.image: NDArray[Any] | None = None
        self._rotation = observer.chart.rotation
        self._checks = StreamChecks()
        self._sizes = observer.stream_sizes()
        self._camera = observer.camera_check()
        self._alarm = StreamAlarm(calibration.alarm, false_alarms(calibration))
        # The last picture and its doubts until its frame is judged.
        self._unjudged: tuple[Look | None, tuple[Reason, ...]] | None = None

    def picture(self, look: Look | None, frame: Frame) -> tuple[Reason, ...]:
        """Return what speaks against a frame's picture among those of the stream.

        It needs nothing of the network. A picture that is passed again because its inference failed
        is the same one, not a repetition.
        """
        moving = checked_hint(frame.moving)
        if self._unjudged is not None and _same_picture(self._unjudged[0], look):
            return self._unjudged[1]
        doubts = self._sizes.doubts(look) + self._checks.picture(look, frame.fresh_noise, moving)
        self._unjudged = look, doubts
        return doubts

    def judge(
        self,
        observation: Observation,
        picture: tuple[Reason, ...],
        seq: int,
        frame: Frame,
        age_ms: float,
    ) -> Verdict:
        """Judge a frame by its own doubts and by the stream.

        ``picture``: what ``picture`` returned; ``age_ms``: the frame's age.
        """
        self.image, self._unjudged = frame.image, None
        own = observation.doubt, observation.fault
        doubts = tuple(reason for reason in own if reason is not None)
        doubts += picture + self._checks.times(frame.stamp_ns, age_ms)
        if self._camera_differs(observation, doubts):
            doubts += (Reason.CAMERA_DIFFERS,)
        judged = None
        if tells_of_the_place(observation):
            judged = self._alarm.judge(observation.outputs, seq)
        if judged is None:
            return Verdict(doubts, self.drift, None)
        if judged.doubt is not None and judged.doubt not in doubts:
            doubts += (judged.doubt,)
        return Verdict(doubts, self.drift, judged.novelty)

    def _camera_differs(self, observation: Observation, doubts: tuple[Reason, ...]) -> bool:
        """Pass a frame to the camera check, unless something else is wrong with it."""
        if self._camera is None or doubts not in ((), (Reason.IMAGE_UNFAMILIAR,)):
            return False
        return self._camera.differs(observation.outputs, familiar=not doubts)

    def remarks(self, observation: Observation, found: ConformalSet) -> tuple[Reason, ...]:
        """Return what is worth knowing of a frame that has an interval, its set."""
        remarks: tuple[Reason, ...] = ()
        if found.crossed:
            remarks += (Reason.BOUNDS_CROSSED,)
        if self._rotation == "euler_zyx" and abs(observation.point[4]) > _STEEP_PITCH:
            remarks += (Reason.PITCH_NEAR_90,)
        return remarks + self._sizes.remarks(observation.look)

    @property
    def unproven(self) -> int:
        """Frames whose equal parts prove no repetition; see ``Odometer.unproven_frames``."""
        return self._checks.unproven

    @property
    def drift(self) -> Drift:
        """Whether the stream's images are still like those of the calibration."""
        return self._alarm.drift

    @property
    def seen_camera(self) -> LensEstimate | None:
        """The camera that the frames show; see ``Odometer.seen_camera``."""
        return None if self._camera is None else self._camera.estimate()
