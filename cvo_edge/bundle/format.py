"""The format of ``calibration.json``: one typed struct for each of its objects."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal, TypeVar

import msgspec
from msgspec import Meta, Struct

from cvo_edge.errors import CalibrationFileError
from cvo_edge.input.preprocess import Crop
from cvo_edge.pose import Rotation
from cvo_edge.sets import Scope

CALIBRATION_FILE = "calibration.json"
MODEL_FILE: Literal["model.onnx"] = "model.onnx"
# A confidence in single precision, e.g. numpy.float32(0.9), means the stored one.
_SAME_CONFIDENCE = 1e-7
# Every bundle stores at least these, for both scopes.
CONFIDENCES = (0.5, 0.8, 0.9, 0.95, 0.99)

# No control characters and no lone surrogates: texts are printed on terminals.
Text = Annotated[
    str, Meta(min_length=1, max_length=200, pattern="^[^\x00-\x1f\x7f-\x9f\ud800-\udfff]+$(?!\n)")
]
Sha256 = Annotated[str, Meta(pattern="^[0-9a-f]{64}$(?!\n)")]
# Metres, radians, probabilities, scales: no output, and no number of a calibration, is near this.
MAX_NUMBER = 1e9
Number = Annotated[float, Meta(gt=-MAX_NUMBER, lt=MAX_NUMBER)]
Positive = Annotated[float, Meta(gt=0, lt=MAX_NUMBER)]
Six = tuple[Number, Number, Number, Number, Number, Number]
SixPositive = tuple[Positive, Positive, Positive, Positive, Positive, Positive]
NumberOrNone = Number | None
SixOrUnbounded = tuple[
    NumberOrNone, NumberOrNone, NumberOrNone, NumberOrNone, NumberOrNone, NumberOrNone
]
Dtype = Literal["uint8", "float32"]
Precision = Literal["fp32", "int8"]
Provider = Literal["onnxruntime", "openvino"]
Rule = Literal["pooled", "hierarchical"]
Joint = Literal["max", "bonferroni"]
Quaternion = tuple[Number, Number, Number, Number]
Parameters = TypeVar("Parameters", bound=Struct)


class _Strict(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Immutable; every key required unless it has a default, none more allowed."""


class TensorSpec(_Strict, frozen=True):
    """One input or output of the model."""

    name: Text
    dtype: Dtype
    shape: tuple[Annotated[int, Meta(ge=1)], ...]


class ModelSpec(_Strict, frozen=True, omit_defaults=True):
    """Which model file this calibration belongs to, and the engine whose numbers it is about.

    In 8 bits engines differ by more than a rounding: thresholds of one are not those of another.
    """

    file: Literal["model.onnx"]
    sha256: Sha256
    opset: Annotated[int, Meta(ge=1)]
    precision: Precision
    inputs: tuple[TensorSpec, ...]
    outputs: tuple[TensorSpec, ...]
    provider: Provider = "onnxruntime"


class PreprocessSpec(_Strict, frozen=True):
    """From a camera image to the model's input; ``in_graph`` names what the model does itself.

    The model then computes (value - mean) / std per channel, in the order rgb, layout NCHW; both
    are null for a given network whose normalisation only its graph knows.
    """

    height: Annotated[int, Meta(ge=16, le=4096)]
    width: Annotated[int, Meta(ge=16, le=4096)]
    colour_order: Literal["rgb"]
    interpolation: Literal["halve_then_linear_exact"]
    crop: Crop
    mean: tuple[Number, Number, Number] | None
    std: tuple[Positive, Positive, Positive] | None
    layout: Literal["nhwc"]
    in_graph: tuple[Literal["cast"], Literal["transpose"], Literal["normalise"]]


class PoseLimits(_Strict, frozen=True):
    """Lowest and highest plausible value per DoF: outside is absurd.

    In the chart of the pose; with ``tangent_predicted``, where a prediction's own rotation numbers
    are zero, in the tangent at ``reference_q_xyzw`` (about nothing where that is null).
    """

    lowest: Six
    highest: Six


class PoseSpec(_Strict, frozen=True):
    """What the six numbers mean, in which frames and units."""

    target: Literal["absolute"]
    frame_id: Text
    child_frame_id: Text
    rotation: Rotation
    reference_q_xyzw: Quaternion | None
    units: tuple[Literal["m"], Literal["rad"]]
    limits: PoseLimits
    standard_deviation: SixPositive


class Threshold(_Strict, frozen=True):
    """q_hat for one confidence and scope; null is unbounded.

    With a two-sided score ``q_hat`` is for the lower side and ``q_hat_upper`` for the upper one;
    for all others ``q_hat_upper`` is null as a whole.
    """

    confidence: Annotated[float, Meta(gt=0, le=1 - 1e-9)]
    scope: Scope
    q_hat: SixOrUnbounded
    q_hat_upper: SixOrUnbounded | None


class SplitSpec(_Strict, frozen=True):
    """Which frames had which role, so that the same test frames can be found again.

    ``purpose``: ``training`` deals all five roles; ``calibration`` deals val, cal and test alone,
    on data that the network has not seen.
    """

    purpose: Literal["training", "calibration"]
    kind: Literal["random", "block", "sequence"]
    seed: Annotated[int, Meta(ge=0)]
    sha256: Sha256


class CalibrationSpec(_Strict, frozen=True):
    """Where the thresholds come from.

    ``joint`` is how six scores become one for the joint scope: the largest of them, made comparable
    on val (``max``), or six thresholds at a sixth of the miscoverage (``bonferroni``).
    """

    score: Text
    joint: Joint
    rule: Rule
    n: Annotated[int, Meta(ge=1, le=10**9)]
    n_sequences: Annotated[int, Meta(ge=1, le=10**9)]
    n_effective: Positive
    split: SplitSpec
    dataset: Text


class SelfTest(_Strict, frozen=True):
    """An image by an integer recipe and what the model must answer to it."""

    recipe: Literal["ripples-1"]
    height: Annotated[int, Meta(ge=16, le=4096)]
    width: Annotated[int, Meta(ge=16, le=4096)]
    outputs: dict[Text, tuple[Number, ...]]
    tolerance: Annotated[float, Meta(gt=0, le=1)]


class Provenance(_Strict, frozen=True):
    """How the bundle was made: names and digests, never a path.

    ``backbone`` and ``training_split`` are null for a given network that came as an ONNX file. The
    split of the run stays when a bundle is calibrated anew: it says which frames are not new.
    """

    created_with: dict[Text, Text]
    seed: Annotated[int, Meta(ge=0)]
    backbone: Text | None
    weights_sha256: Sha256 | None
    dataset: Text
    training_split: SplitSpec | None
    options: dict[Text, Text | int | float | bool | None]


class Calibration(_Strict, frozen=True):
    """The whole of ``calibration.json``, version 1."""

    schema_version: Literal[1]
    name: Text
    method: Text
    model: ModelSpec
    preprocess: PreprocessSpec
    pose: PoseSpec
    thresholds: Annotated[tuple[Threshold, ...], Meta(min_length=1)]
    method_parameters: dict[str, Any]
    calibration: CalibrationSpec
    selftest: SelfTest
    provenance: Provenance
    digest: Sha256

    def threshold(self, confidence: float, scope: Scope) -> Threshold | None:
        """Return the stored threshold for this confidence and scope, or None."""
        for entry in self.thresholds:
            if entry.scope == scope and math.isclose(
                entry.confidence, confidence, abs_tol=_SAME_CONFIDENCE
            ):
                return entry
        return None

    def confidences(self, scope: Scope) -> tuple[float, ...]:
        """Return the confidences stored for this scope, ascending."""
        return tuple(sorted(entry.confidence for entry in self.thresholds if entry.scope == scope))

    def parameters(self, kind: type[Parameters]) -> Parameters:
        """Return ``method_parameters`` as the method's own struct.

        Raises CalibrationFileError where they are another method's, or out of their ranges.
        """
        try:
            return msgspec.convert(self.method_parameters, kind, strict=True)
        except msgspec.ValidationError as error:
            raise CalibrationFileError(f"method_parameters: {one_line(str(error))}") from None


def shown(value: object) -> str:
    """Return what was found, as one line of bounded length for an error message."""
    return one_line(repr(value))


def one_line(text: str) -> str:
    """Return a text as one line of at most 160 characters."""
    line = " ".join(text.split())
    return line if len(line) <= 160 else line[:157] + "..."
