"""Camera image -> observation: model input, outputs, pose, and results of the frame checks.

Nothing here needs a threshold, because calibration observes frames before thresholds exist.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from operator import le
from time import perf_counter
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from cvo_edge.bundle.format import MAX_NUMBER, ImageSpec, ModelSpec, PoseSpec, PreprocessSpec
from cvo_edge.camera import Camera
from cvo_edge.camera_check import CameraCheck
from cvo_edge.engine.loading import open_session
from cvo_edge.engine.model_cache import CachedModel
from cvo_edge.engine.session import Session
from cvo_edge.errors import UsageError
from cvo_edge.heads import Head
from cvo_edge.input import preprocess
from cvo_edge.input.frame_checks import Look, image_doubt
from cvo_edge.input.half import check_decoder
from cvo_edge.input.image_checks import ROUNDING_PX, KnownImages, StreamSizes
from cvo_edge.input.view import View, check_same_view, crop_view, matched_view, seen_camera
from cvo_edge.pose import Chart
from cvo_edge.record import Reason

Array = NDArray[np.float64]

# A solver uses the shape of its camera's images exactly, as far as sizes are whole pixels.
_SOLVER_ROUNDING_PX = 0.5
# Up to this size, a plain Python loop is faster than the first numpy call.
_FEW = 64
_NO_POSE = np.full(7, np.nan)
_NO_POSE.setflags(write=False)


class Prepared(NamedTuple):
    """What the network gets of one image, and the results of the checks of that image.

    Attributes
    ----------
    tensor, look
        The model's input (1, height, width, 3) uint8 RGB, and image data for the stream checks;
        both None if there is no image.
    fault, doubt
        As for ``Observation``.
    preprocess_ms
        Time that this took.
    """

    tensor: NDArray[np.uint8] | None = None
    look: Look | None = None
    fault: Reason | None = None
    doubt: Reason | None = None
    preprocess_ms: float = 0.0


@dataclass(frozen=True, eq=False)
class Observation:
    """The network's results for one image, before any threshold is applied.

    Attributes
    ----------
    outputs
        Model outputs by name, and what the method's solver adds, each with a leading axis of one.
    pose, point
        Shape (7,) with a unit quaternion, and shape (6,): the same pose in the bundle's chart. As
        in the outputs, positions are relative to the bundle's ``origin_m``.
    fault
        Why these results must not be used, or None.
    doubt
        Why no interval may be claimed, or None.
    look
        Image data for the stream checks, or None if there is no image.
    """

    outputs: Mapping[str, NDArray[np.float32]]
    pose: Array
    point: Array
    fault: Reason | None = None
    doubt: Reason | None = None
    look: Look | None = None
    preprocess_ms: float = 0.0
    model_ms: float = 0.0


class Observer:
    """One network with its preprocessing, chart and frame checks.

    Parameters
    ----------
    model
        The model's bytes, or its cached form.
    spec, inputs, pose
        The calibration's description of the model, its input and the poses.
    head
        The method, which may need inputs besides the image, and may solve for the pose.
    learned
        The camera of the images that the network has learned; None if its intrinsics are unknown.
    camera
        The camera that takes the images, by default the learned one.
    images
        The images of the calibration; None if they are unknown.
    threads
        Threads of one inference; all allowed cores by default.
    spinning
        Whether these threads busy-wait for each other.
    at_once
        Number of threads that call ``observe`` concurrently.

    Raises
    ------
    ModelError, BundleMismatchError
        The engine refuses the model, or the model does not match ``spec``.
    UsageError
        The images of ``camera`` cannot be brought to the view that the network has learned, or not
        be decoded at half size where ``inputs`` says so.
    GateError
        They are to be decoded at half size, and this machine's decoder has other rules.
    """

    def __init__(
        self,
        model: bytes | CachedModel,
        spec: ModelSpec,
        inputs: PreprocessSpec,
        pose: PoseSpec,
        head: Head,
        learned: Camera | None = None,
        camera: Camera | None = None,
        images: ImageSpec | None = None,
        *,
        threads: int | None = None,
        spinning: bool = True,
        at_once: int = 1,
    ) -> None:
        self.session: Session | None = open_session(
            model, threads, spec, spinning=spinning, at_once=at_once
        )
        if inputs.decode == "half":
            check_decoder()
        self._inputs = inputs
        self._head = head
        self._seen = None
        self._cameras: tuple[Camera, Camera] | None = None
        if learned is not None:
            shape = inputs.height, inputs.width, inputs.crop
            own = crop_view(learned.height, learned.width, *shape).camera(learned)
            self._cameras = camera or learned, own
            self._seen = seen_camera(*self._cameras, inputs.crop)
            if camera is not None and not head.solves:
                check_same_view(camera, learned, own, inputs.crop)
        elif camera is not None:
            raise UsageError(
                "camera: expected a bundle that states the intrinsics of its own camera, found "
                "none; omit it, and give images of that camera"
            )
        self._solver = head.solver(self._seen)
        # The view is found by the cameras, not by the image's shape alone.
        self._matched = self._cameras is not None and (head.solves or camera is not None)
        # Of the last image: nearly all of a stream have one size.
        self._last_view: tuple[tuple[int, int], View] | None = None
        self._known = self._known_images(camera, images)
        reference = None if pose.reference_q_xyzw is None else np.array(pose.reference_q_xyzw)
        absolute = pose.rotation == "tangent_reference"
        self.chart = Chart(pose.rotation, reference if absolute else None)
        # Every prediction is the origin of its own tangent space: limits need a fixed origin.
        self._limits_chart = self.chart
        if reference is not None and pose.rotation == "tangent_predicted":
            self._limits_chart = Chart("tangent_reference", reference)
        self._limits = pose.limits
        self.origin_m = pose.origin_m

    def __enter__(self) -> Self:
        """Return itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close it."""
        self.close()

    def close(self) -> None:
        """Release the model's memory; a second call has no effect."""
        self.session = None

    def observe(self, image_bgr: NDArray[Any] | None, seq: int) -> Observation:
        """Run the network on one image; ``fault`` and ``doubt`` report failed checks.

        Parameters
        ----------
        image_bgr
            As for ``Odometer.step``.
        seq
            Number of the frame; seeds the noise input of methods that have one.

        Raises
        ------
        UsageError
            The observer is closed, or the process was forked after loading.
        ModelError
            Inference failed.
        """
        return self.infer(self.prepare(image_bgr), seq)

    def prepare(self, image_bgr: NDArray[Any] | None) -> Prepared:
        """Bring one image to the network's input and check it; argument as for ``observe``."""
        if image_bgr is None:
            return Prepared(fault=Reason.IMAGE_UNREADABLE)
        start = perf_counter()
        image = preprocess.to_bgr8(image_bgr)
        if image is None:
            return Prepared(fault=Reason.IMAGE_UNSUPPORTED)
        size = image.shape[0], image.shape[1]
        if (last := self._last_view) is None or last[0] != size:
            self._last_view = last = size, self._view(*size)
        view = last[1]
        tensor = preprocess.viewed(image, view)[np.newaxis]
        look = Look(tensor, size)
        doubt = image_doubt(look)
        if doubt is None and self._known is not None:
            doubt = self._known.doubt(look, view.enlarged)
        return Prepared(tensor, look, None, doubt, 1e3 * (perf_counter() - start))

    def infer(self, prepared: Prepared, seq: int) -> Observation:
        """Run the network on what ``prepare`` returned; number and errors as for ``observe``."""
        session = self.session
        if session is None:
            raise UsageError("the odometer is closed; load it again")
        tensor, look, fault, doubt, preprocess_ms = prepared
        if tensor is None:
            return Observation({}, _NO_POSE, _NO_POSE[:6], fault)
        start = perf_counter()
        outputs: Mapping[str, NDArray[Any]]
        outputs = session.run({"image": tensor, **self._head.extra_inputs(seq)})
        fault = _output_fault(outputs)
        if self._solver is not None and fault is None:
            outputs, unsure = self._solver(outputs)
            doubt = doubt or unsure
        done = perf_counter()
        pose, point, fault = self._checked(outputs, fault)
        model_ms = 1e3 * (done - start)
        return Observation(outputs, pose, point, fault, doubt, look, preprocess_ms, model_ms)

    def solver_error(self) -> float:
        """As ``Head.solver_error``, for the camera of the images."""
        return self._head.solver_error(self._seen)

    def camera_check(self) -> CameraCheck | None:
        """Return a check of the camera for a new stream, or None if the method has none."""
        return self._head.camera_check(self._seen)

    def stream_sizes(self) -> StreamSizes:
        """Return a check of the sizes of the images of a new stream."""
        return StreamSizes(None if self._known is None else self._known.size)

    def _view(self, height: int, width: int) -> View:
        """Return the view of an image, which need not have the size that its camera states."""
        if not self._matched or self._cameras is None:
            inputs = self._inputs
            return crop_view(height, width, inputs.height, inputs.width, inputs.crop)
        camera, own = self._cameras
        return matched_view(camera.scaled(width, height), own, self._inputs.crop)

    def _known_images(self, camera: Camera | None, images: ImageSpec | None) -> KnownImages | None:
        """Return the images to expect: those of the camera, or else those of the calibration."""
        rounding_px, sized = ROUNDING_PX, camera or images
        if self._head.solves:
            rounding_px = _SOLVER_ROUNDING_PX
            sized = self._cameras and self._cameras[0]
        if sized is None:
            return None
        size, half = (sized.height, sized.width), self._inputs.decode == "half"
        if half:
            self._inputs.check_halves(*size)
            size = size[0] // 2, size[1] // 2
        colour = images is not None and images.colour
        return KnownImages(size, colour, max(1.0, self._view(*size).enlarged), rounding_px, half)

    def _checked(
        self, outputs: Mapping[str, NDArray[Any]], fault: Reason | None
    ) -> tuple[Array, Array, Reason | None]:
        """Outputs and their fault -> unit pose (7,), point (6,), and the fault or None.

        For so few numbers plain Python is faster than numpy, whose code the inference has just
        evicted from the processor's caches.
        """
        if fault is Reason.OUTPUT_NOT_FINITE or "pose" not in outputs:
            return _NO_POSE, _NO_POSE[:6], fault
        values = outputs["pose"][0].tolist()
        length = math.hypot(*values[3:])
        # Normalised, with the sign that gives qw >= 0.
        scale = math.copysign(length, values[6]) if length > 0.0 else math.nan
        pose = np.array([*values[:3], *(value / scale for value in values[3:])])
        point = plausible = self.chart.point(pose)
        if self._limits_chart is not self.chart:
            plausible = self._limits_chart.point(pose)
        # Written so that NaN (a zero quaternion) fails the check.
        place, limits = plausible.tolist(), self._limits
        inside = all(map(le, limits.lowest, place)) and all(map(le, place, limits.highest))
        return pose, point, fault if inside else Reason.POSE_IMPLAUSIBLE


def _output_fault(outputs: Mapping[str, NDArray[Any]]) -> Reason | None:
    if all(map(_sensible, outputs.values())):
        return None
    if all(np.isfinite(output).all() for output in outputs.values()):
        return Reason.OUTPUT_ABSURD
    return Reason.OUTPUT_NOT_FINITE


def _sensible(output: NDArray[np.float32]) -> bool:
    """Whether all numbers are finite and of plausible size."""
    if output.size > _FEW:
        return bool(np.abs(output).max() < MAX_NUMBER)
    values = output.ravel().tolist()
    # The usual case in one call: no number is larger than their norm, which NaN makes NaN.
    if math.hypot(*values) < MAX_NUMBER:
        return True
    # max() may miss a NaN that is not the first value; sum() does not.
    return max(map(abs, values)) < MAX_NUMBER and not math.isnan(sum(values))
