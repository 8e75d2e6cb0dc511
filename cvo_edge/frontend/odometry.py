"""Rotation and direction of a camera's motion from image to image, by features alone."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from cvo_edge import geometry
from cvo_edge.camera import Camera, checked_camera
from cvo_edge.frontend.essential import LEAST_INLIERS, Motion, solve
from cvo_edge.frontend.lens import Lens
from cvo_edge.frontend.steps import Step, StepReason
from cvo_edge.frontend.tracks import Grey, corners, follow
from cvo_edge.input.frame import Frame
from cvo_edge.input.preprocess import to_bgr8
from cvo_edge.scheduling import run_stream

Array = NDArray[np.float64]
# Stamps of two frames -> metres between them, None if unknown.
Lengths = Callable[[int, int], float | None]


class FrontEnd:
    """Estimates how one calibrated camera turns and moves, without a network and without a scale.

    The motion of a step has a rotation, and a direction if there is parallax. One instance serves
    one stream. The same images give the same steps.

    Parameters
    ----------
    camera
        The camera that takes the images.
    lengths
        Metres that the camera moves between two stamps, by other sensors.

    Raises UsageError for a camera that cannot be one.
    """

    def __init__(self, camera: Camera, lengths: Lengths | None = None) -> None:
        self.camera = checked_camera(camera)
        self._lens = Lens(self.camera)
        self._lengths = lengths
        self._before: Grey | None = None
        self._stamp_ns: int | None = None
        self._size: tuple[int, int] | None = None
        self._seq = 0
        self._turn = np.eye(3)
        self._t = np.zeros(3)
        self._q = np.array([0.0, 0.0, 0.0, 1.0])

    def __repr__(self) -> str:
        camera = self.camera
        return f"<FrontEnd {camera.width}x{camera.height}, {self._seq} frames>"

    def stream(self, frames: Iterable[Frame | NDArray[Any]]) -> Generator[Step, None, None]:
        """Yield a step for each frame of a source; of a live one, for the newest frames.

        Raises the source's errors.
        """
        return run_stream(frames, "latency", 1, self._take, lambda: self._seq)

    def step(self, image: NDArray[Any] | None, stamp_ns: int | None = None) -> Step:
        """Take the next image, as ``Odometer.step`` does, and return the motion since the last.

        After an image that cannot be used, the next one has nothing before it, either.
        """
        return self._take(Frame(image, stamp_ns, "", 0.0), self._seq)

    def _take(self, frame: Frame, seq: int) -> Step:
        self._seq = seq + 1
        before, self._before = self._before, None
        earlier_ns, self._stamp_ns = self._stamp_ns, frame.stamp_ns
        image = grey(frame.image)
        self._size = None if image is None else (image.shape[0], image.shape[1])
        if image is None:
            return self._lost(frame, seq, StepReason.IMAGE_UNREADABLE)
        if image.shape != (self.camera.height, self.camera.width):
            return self._lost(frame, seq, StepReason.IMAGE_SIZE)
        self._before = image
        if before is None:
            return self._step(frame, seq, (StepReason.NOTHING_BEFORE,), 0, None, None)
        tracks = follow(before, image, corners(before))
        x1, x2 = self._lens.rays(tracks.first), self._lens.rays(tracks.second)
        known = np.isfinite(x1).all(axis=0) & np.isfinite(x2).all(axis=0)
        count = int(known.sum())
        if count < LEAST_INLIERS:
            return self._lost(frame, seq, StepReason.TRACKS_FEW, count)
        motion = solve(x1[:, known], x2[:, known], self._lens.focal_px, self._turn)
        if motion is None:
            return self._lost(frame, seq, StepReason.NO_CONSENSUS, count)
        length_m = None
        if self._lengths is not None:
            if earlier_ns is not None and frame.stamp_ns is not None:
                length_m = self._lengths(earlier_ns, frame.stamp_ns)
            if length_m is None:
                return self._lost(frame, seq, StepReason.LENGTH_MISSING, count)
        reasons = () if motion.direction is not None else (StepReason.PARALLAX_SMALL,)
        return self._step(frame, seq, reasons, count, motion, length_m)

    def _lost(self, frame: Frame, seq: int, reason: StepReason, tracks: int = 0) -> Step:
        self._turn = np.eye(3)
        nowhere = np.full(7, np.nan)
        size = self._size
        return Step(seq, frame.stamp_ns, frame.source, (reason,), tracks, None, None, nowhere, size)

    def _step(
        self,
        frame: Frame,
        seq: int,
        reasons: tuple[StepReason, ...],
        tracks: int,
        motion: Motion | None,
        length_m: float | None,
    ) -> Step:
        self._turn = np.eye(3) if motion is None else motion.R
        if motion is not None:
            if motion.direction is not None:
                length = 1.0 if length_m is None else length_m
                R = geometry.quaternion_to_matrix(self._q)
                self._t = self._t + length * (R @ motion.direction)
            turn = geometry.matrix_to_quaternion(motion.R)
            self._q = geometry.quaternion_normalise(geometry.quaternion_multiply(self._q, turn))
        pose = np.concatenate([self._t, self._q])
        size = self._size
        return Step(
            seq, frame.stamp_ns, frame.source, reasons, tracks, motion, length_m, pose, size
        )


def grey(image: object) -> Grey | None:
    """Return any camera image as (height, width) uint8, None if it is not supported."""
    if isinstance(image, np.ndarray) and image.ndim == 2 and image.dtype == np.uint8:
        return np.ascontiguousarray(image)
    found = to_bgr8(image)
    return None if found is None else np.asarray(cv2.cvtColor(found, cv2.COLOR_BGR2GRAY), np.uint8)
