"""Camera image -> what the network says of it: model input, outputs, pose, and whether they count.

Nothing here needs a threshold: calibration observes frames before there is one.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from time import perf_counter
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from cvo_edge.bundle.format import MAX_NUMBER, ModelSpec, PoseSpec, PreprocessSpec
from cvo_edge.engine.loading import open_session
from cvo_edge.engine.model_cache import PreparedModel
from cvo_edge.engine.session import Session
from cvo_edge.errors import UsageError
from cvo_edge.estimate import Reason
from cvo_edge.heads import Head
from cvo_edge.input import preprocess
from cvo_edge.input.frame_checks import Look, image_doubt
from cvo_edge.pose import Chart

Array = NDArray[np.float64]

# Python looks at so few numbers in less time than numpy's first call takes.
_FEW = 64


@dataclass(frozen=True, eq=False)
class Observation:
    """What the network says of one image, before any threshold.

    Attributes
    ----------
    outputs
        By name, each with a leading axis of one.
    pose, point
        Shape (7,), with a unit quaternion, and (6,), the same pose in the bundle's chart.
    fault
        Why none of these may be used; None where they may.
    doubt
        Why no interval may be claimed; None where one may.
    look
        What the stream checks need of the image; None where there is no image.
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
        The model's bytes, or its prepared form.
    spec, inputs, pose
        What the calibration says of the model, of its input and of the poses.
    head
        The method, which may ask for inputs besides the image.
    threads
        Threads of one inference; all allowed cores by default.
    spinning
        Whether these threads wait for one another at full speed.
    at_once
        Number of threads that call ``observe`` at the same time.

    Raises
    ------
    ModelError, BundleMismatchError
        The engine refuses the model, or it is not the one that ``spec`` describes.
    """

    def __init__(
        self,
        model: bytes | PreparedModel,
        spec: ModelSpec,
        inputs: PreprocessSpec,
        pose: PoseSpec,
        head: Head,
        *,
        threads: int | None = None,
        spinning: bool = True,
        at_once: int = 1,
    ) -> None:
        self.session: Session | None = open_session(
            model, threads, spec, spinning=spinning, at_once=at_once
        )
        self._inputs = inputs
        self._head = head
        reference = None if pose.reference_q_xyzw is None else np.array(pose.reference_q_xyzw)
        absolute = pose.rotation == "tangent_reference"
        self.chart = Chart(pose.rotation, reference if absolute else None)
        # A prediction is the origin of its own tangent: what is plausible needs a fixed one.
        self._limits_chart = self.chart
        if reference is not None and pose.rotation == "tangent_predicted":
            self._limits_chart = Chart("tangent_reference", reference)
        self._limits = pose.limits

    def __enter__(self) -> Self:
        """Return itself."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Close it."""
        self.close()

    def close(self) -> None:
        """Give back the model's memory; closing twice is harmless."""
        self.session = None

    def observe(self, image_bgr: NDArray[Any] | None, seq: int) -> Observation:
        """Run the network on one image; frame checks report in ``fault`` and ``doubt``.

        Parameters
        ----------
        image_bgr
            As ``Odometer.step`` takes it.
        seq
            Number of the frame, which seeds the noise of a method that draws some.

        Raises
        ------
        UsageError
            After ``close``, and in a forked process.
        ModelError
            The engine failed.
        """
        session = self.session
        if session is None:
            raise UsageError("Odometer: expected an open one, found it closed")
        if image_bgr is None:
            return _faulty(Reason.IMAGE_UNREADABLE)
        start = perf_counter()
        image = preprocess.to_bgr8(image_bgr)
        if image is None:
            return _faulty(Reason.IMAGE_UNSUPPORTED)
        inputs = self._inputs
        tensor = preprocess.model_input(image, inputs.height, inputs.width, inputs.crop)
        look = Look(tensor, (image.shape[0], image.shape[1]))
        doubt = image_doubt(look)
        ready = perf_counter()
        outputs = session.run({"image": tensor, **self._head.extra_inputs(seq)})
        done = perf_counter()
        pose, point, fault = self._checked(outputs)
        spent_ms = 1e3 * (ready - start), 1e3 * (done - ready)
        return Observation(outputs, pose, point, fault, doubt, look, *spent_ms)

    def _checked(
        self, outputs: Mapping[str, NDArray[np.float32]]
    ) -> tuple[Array, Array, Reason | None]:
        """Outputs -> unit pose (7,) and point (6,), and what is wrong with them.

        The network has just driven everything else out of the processor's caches: a few numbers
        are cheaper one by one in Python than by several calls into numpy.
        """
        values = outputs["pose"][0].tolist()
        sensible = all(map(_sensible, outputs.values()))
        if not sensible and not all(np.isfinite(output).all() for output in outputs.values()):
            return np.array(values), np.array(values[:6]), Reason.OUTPUT_NOT_FINITE
        length = math.hypot(*values[3:])
        # Unit, and of the two quaternions of a rotation the one with qw >= 0.
        scale = math.copysign(length, values[6]) if length > 0.0 else math.nan
        pose = np.array([*values[:3], *(value / scale for value in values[3:])])
        point = plausible = self.chart.point(pose)
        if self._limits_chart is not self.chart:
            plausible = self._limits_chart.point(pose)
        # Written so that NaN (a zero quaternion) fails the check.
        inside = all(
            lowest <= value <= highest
            for lowest, value, highest in zip(
                self._limits.lowest, plausible.tolist(), self._limits.highest, strict=True
            )
        )
        if not inside:
            return pose, point, Reason.POSE_IMPLAUSIBLE
        return pose, point, None if sensible else Reason.OUTPUT_ABSURD


def _sensible(output: NDArray[np.float32]) -> bool:
    """Whether all numbers are there and none is absurd."""
    if output.size > _FEW:
        return bool(np.abs(output).max() < MAX_NUMBER)
    values = output.ravel().tolist()
    # A sum keeps NaN wherever it stands, a maximum only where it comes first.
    return max(map(abs, values)) < MAX_NUMBER and not math.isnan(sum(values))


def _faulty(reason: Reason) -> Observation:
    return Observation({}, np.full(7, np.nan), np.full(6, np.nan), reason)
