"""A bundle before calibration: everything that does not depend on a score or a threshold."""

from __future__ import annotations

import hashlib
import importlib.metadata
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import msgspec
import numpy as np
import onnx
from numpy.typing import NDArray

from cvo_edge import geometry
from cvo_edge.bundle.format import (
    MODEL_FILE,
    SELFTEST_TOLERANCE,
    AlarmSpec,
    Calibration,
    CalibrationSpec,
    DifficultySpec,
    ImageSpec,
    ModelSpec,
    PoseLimits,
    PoseSpec,
    PreprocessSpec,
    Provenance,
    Quaternion,
    SelfTest,
    Six,
    SixPositive,
    SplitSpec,
    Threshold,
    version_of,
)
from cvo_edge.camera import Camera
from cvo_edge.documents import UNWRITTEN
from cvo_edge.engine.observation import Observer
from cvo_edge.engine.session import Session
from cvo_edge.heads import HEADS, Candidate, Head
from cvo_edge.heads.checked import check_tensors
from cvo_edge.pose import Chart
from cvo_edge.vocabulary import Joint, Precision, Provider, Rule
from cvo_export.datasets.motion import MAX_SPREAD_RAD

Array = NDArray[np.float64]

WORLD_FRAME, CAMERA_FRAME = "world", "camera"

# Least half-width in the normalised score, in standard deviations of each DoF.
HALF_WIDTH_FLOOR = 0.01
_LEAST_DEVIATION = 1e-6
_FULL_TURN = float(np.pi)

# Margin of plausible poses around the known ones, as a share of each DoF's range.
_LIMIT_MARGIN = 0.5
# Least margin in metres and radians where there may be few known poses.
FEW_POSES_MARGIN = 1.0
# Share of images with colour from which those without it are doubted, and not calibrated with.
_COLOURED = 0.95
# Operators on 8-bit numbers.
_QUANTISED = {
    "ConvInteger",
    "DynamicQuantizeLinear",
    "MatMulInteger",
    "QGemm",
    "QLinearConv",
    "QLinearMatMul",
    "QuantizeLinear",
}
# Height and width of the self-test image. No camera and no model has this shape, so the self-test
# covers resizing and cropping too.
SELFTEST_SIZE = (418, 650)


@dataclass(frozen=True)
class Draft:
    """The part of a bundle that does not depend on its calibration; see ``Calibration``.

    Attributes
    ----------
    method
        Name of the runtime head.
    camera
        The camera that the bundle states, for a solver that of the training images; None if it is
        unknown.
    rule, cap, joint, split, dataset
        How to compute the thresholds, and from which frames; ``cap`` is None but for ``capped``.
    running
        The camera of the calibration images, if it is not ``camera``.
    images
        Their size and colour; None before they have been read.
    crossed
        Number of folds of a crossed calibration, or None.
    difficulty
        What scales the sets from frame to frame; None for nothing, and before it is fitted.
    """

    name: str
    method: str
    model: ModelSpec
    preprocess: PreprocessSpec
    pose: PoseSpec
    provenance: Provenance
    camera: Camera | None
    rule: Rule
    joint: Joint
    split: SplitSpec
    dataset: str
    running: Camera | None = None
    images: ImageSpec | None = None
    cap: float | None = None
    crossed: int | None = None
    difficulty: DifficultySpec | None = None

    @classmethod
    def of(cls, calibration: Calibration) -> Draft:
        """Return the draft of an existing bundle, to calibrate it again."""
        source = calibration.calibration
        return cls(
            name=calibration.name,
            method=calibration.method,
            model=calibration.model,
            preprocess=calibration.preprocess,
            pose=calibration.pose,
            provenance=calibration.provenance,
            camera=calibration.camera,
            rule=source.rule,
            cap=source.cap,
            joint=source.joint,
            split=source.split,
            dataset=source.dataset,
        )

    def head(self, candidate: Candidate) -> Head:
        """Return the method's head with one of its scores.

        Raises BundleMismatchError if the model does not have the tensors that the head needs.
        """
        head = HEADS[self.method](candidate.parameters, candidate.score).scaled(self.difficulty)
        check_tensors(self.model, head)
        return head

    def observer(self, model_bytes: bytes, head: Head, *, stated: bool = False) -> Observer:
        """Return an observer that runs the network; raises ModelError and BundleMismatchError.

        ``stated``: for images of the camera that the bundle states, instead of the running one.
        """
        cameras = self.camera, None if stated else self.running
        spec = self.model, self.preprocess, self.pose
        return Observer(model_bytes, *spec, head, *cameras, self.images)

    def calibrated(
        self,
        head: Head,
        thresholds: tuple[Threshold, ...],
        counts: Counts,
        selftest: Mapping[str, tuple[float, ...]],
        alarm: AlarmSpec | None,
    ) -> Calibration:
        """Return the content of ``calibration.json``; the digest is set when it is written.

        ``selftest`` holds the network's outputs for the self-test image, by name.
        """
        height, width = SELFTEST_SIZE
        return Calibration(
            schema_version=version_of(self.preprocess, None),
            name=self.name,
            method=self.method,
            model=self.model,
            preprocess=self.preprocess,
            pose=self.pose,
            thresholds=thresholds,
            method_parameters=msgspec.to_builtins(head.parameters),
            calibration=CalibrationSpec(
                score=head.score,
                joint=self.joint,
                rule=self.rule,
                cap=self.cap,
                n=counts.frames,
                n_sequences=counts.sequences,
                n_effective=counts.effective,
                split=self.split,
                dataset=self.dataset,
                crossed=self.crossed,
            ),
            selftest=SelfTest(
                recipe="ripples-1",
                height=height,
                width=width,
                outputs=dict(selftest),
                tolerance=SELFTEST_TOLERANCE[self.model.precision],
            ),
            provenance=self.provenance,
            camera=self.camera,
            images=self.images,
            alarm=alarm,
            difficulty=self.difficulty,
            digest=UNWRITTEN,
        )


class Counts(NamedTuple):
    """Size of a calibration sample: frames, sequences and effective (independent) frames."""

    frames: int
    sequences: int
    effective: float


def images_of(
    draft: Draft, size: tuple[int, int], coloured: Sequence[NDArray[np.bool_]]
) -> ImageSpec:
    """Describe calibration images that were read in a width and height.

    ``coloured`` (n,) tells role by role which have colour. The size is that of the bundle's camera,
    if it states one: a solver that was calibrated with another one is used with its own.
    """
    camera, times = draft.camera, 2 if draft.preprocess.decode == "half" else 1
    width, height = (times * side for side in size)
    if camera is not None:
        width, height = camera.width, camera.height
    # Without an image with colour, a role would have no frame left.
    colour = np.concatenate(coloured).mean() >= _COLOURED and all(each.any() for each in coloured)
    return ImageSpec(width=width, height=height, colour=bool(colour))


def model_spec(model_bytes: bytes, opset: int, provider: Provider = "onnxruntime") -> ModelSpec:
    """Describe a model for ``calibration.json``; any quantised operator makes it int8."""
    session = Session(model_bytes)
    return ModelSpec(
        file=MODEL_FILE,
        sha256=hashlib.sha256(model_bytes).hexdigest(),
        opset=opset,
        precision=_precision(model_bytes),
        inputs=session.inputs,
        outputs=session.outputs,
        provider=provider,
    )


def _precision(model_bytes: bytes) -> Precision:
    kinds = {node.op_type for node in onnx.load_from_string(model_bytes).graph.node}
    return "int8" if kinds & _QUANTISED else "fp32"


def known_coordinates(poses: Array, reference_q_xyzw: Array) -> Array:
    """Convert poses (n, 7) to position and tangent at a reference rotation, (n, 6), m and rad."""
    return Chart("tangent_reference", reference_q_xyzw).coordinates(poses, poses)


def known_space(
    poses: Array,
) -> tuple[Quaternion | None, PoseLimits, SixPositive]:
    """Return mean rotation, plausible limits and standard deviation of known poses (n, 7).

    Limits and deviation are in the tangent at the mean rotation. The rotation is None if the poses
    spread too far for one tangent.
    """
    reference = geometry.mean_rotation(poses[:, 3:])
    coordinates = known_coordinates(poses, reference)
    spread = float(np.linalg.norm(coordinates[:, 3:], axis=1).max())
    return (
        four(reference) if spread <= MAX_SPREAD_RAD else None,
        plausible(coordinates, FEW_POSES_MARGIN),
        six(np.maximum(coordinates.std(axis=0), _LEAST_DEVIATION)),
    )


def plausible(coordinates: Array, least_margin: float | Array = 0.0) -> PoseLimits:
    """Return limits half a range beyond the known poses (n, 6) on each side.

    The margin is at least ``least_margin``, in metres and radians, a number or (6,), because a few
    poses cover only part of where a camera goes.
    """
    lowest, highest = coordinates.min(axis=0), coordinates.max(axis=0)
    margin = np.maximum(_LIMIT_MARGIN * (highest - lowest), least_margin)
    return PoseLimits(lowest=six(lowest - margin), highest=six(highest + margin))


def with_any_rotation(limits: PoseLimits) -> PoseLimits:
    """Keep the limits of the position; any rotation is plausible."""
    return PoseLimits(
        lowest=(*limits.lowest[:3], *(-_FULL_TURN,) * 3),
        highest=(*limits.highest[:3], *(_FULL_TURN,) * 3),
    )


def still_text(still: Sequence[str]) -> str:
    """Say which degrees of freedom hardly moved in training, and what leaves them out."""
    return f"{' '.join(still)} hardly moved in training: scores and mean widths leave them out"


def versions(packages: Sequence[str]) -> dict[str, str]:
    """Return the version of each installed package, for the provenance."""
    return {package: importlib.metadata.version(package) for package in packages}


def four(values: Array) -> Quaternion:
    """Convert an array (4,) to a quaternion."""
    x, y, z, w = (float(value) for value in values)
    return (x, y, z, w)


def six(values: Array) -> Six:
    """Convert an array (6,) to a tuple of six numbers."""
    a, b, c, d, e, f = (float(value) for value in values)
    return (a, b, c, d, e, f)
