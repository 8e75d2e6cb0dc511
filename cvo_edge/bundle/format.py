"""The format of ``calibration.json``: one typed struct for each of its objects."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal, TypeVar

import msgspec
from msgspec import Meta, Struct

from cvo_edge.camera import LEAST_SIDE, Camera
from cvo_edge.documents import one_line
from cvo_edge.errors import CalibrationFileError, UsageError
from cvo_edge.pose import Rotation
from cvo_edge.vocabulary import Crop, Decode, Joint, Precision, Provider, Rule, Scope, SplitKind

CALIBRATION_FILE = "calibration.json"
MODEL_FILE: Literal["model.onnx"] = "model.onnx"
# Tolerance for confidences in single precision, e.g. numpy.float32(0.9).
SAME_CONFIDENCE = 1e-7
# Every bundle stores at least these confidences, for both scopes.
CONFIDENCES = (0.5, 0.8, 0.9, 0.95, 0.99)

# What a graph may tell of a frame besides its pose: the four numbers of the output ``novelty`` and
# the one of ``degradation``.
STATISTICS = ("nearest", "cell", "mean", "colour", "degradation")
NOVELTY_OUTPUT, DEGRADATION_OUTPUT = "novelty", "degradation"
# The outputs that a graph of any method may have for that, with their shapes.
FAMILIARITY = {NOVELTY_OUTPUT: (1, len(STATISTICS) - 1), DEGRADATION_OUTPUT: (1, 1)}

# No control characters and no lone surrogates: texts are printed on terminals.
Text = Annotated[
    str, Meta(min_length=1, max_length=200, pattern="^[^\x00-\x1f\x7f-\x9f\ud800-\udfff]+$(?!\n)")
]
Sha256 = Annotated[str, Meta(pattern="^[0-9a-f]{64}$(?!\n)")]
# Tolerance of the self-test: metres, radians, probabilities. In 8 bits, different rounding on
# another kind of processor moves outputs by up to 0.005; saturated products move them by more than
# 0.015 (see boards/).
SELFTEST_TOLERANCE: dict[Precision, float] = {"fp32": 1e-3, "int8": 1e-2}
# Far above every plausible value, whether metres, radians, probabilities or scales.
MAX_NUMBER = 1e9
# Of the logarithm of a factor between the sets of two frames: up to 150 times as wide.
MOST_DIFFICULTY = 5.0
Number = Annotated[float, Meta(gt=-MAX_NUMBER, lt=MAX_NUMBER)]
Positive = Annotated[float, Meta(gt=0, lt=MAX_NUMBER)]
Six = tuple[Number, Number, Number, Number, Number, Number]
SixPositive = tuple[Positive, Positive, Positive, Positive, Positive, Positive]
Five = tuple[Number, Number, Number, Number, Number]
FivePositive = tuple[Positive, Positive, Positive, Positive, Positive]
NumberOrNone = Number | None
SixOrUnbounded = tuple[
    NumberOrNone, NumberOrNone, NumberOrNone, NumberOrNone, NumberOrNone, NumberOrNone
]
Dtype = Literal["uint8", "float32"]
Quaternion = tuple[Number, Number, Number, Number]
Position = tuple[Number, Number, Number]
Parameters = TypeVar("Parameters", bound=Struct)


class _Strict(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Immutable; keys without a default are required, unknown keys are an error."""


class TensorSpec(_Strict, frozen=True):
    """One input or output of the model."""

    name: Text
    dtype: Dtype
    shape: tuple[Annotated[int, Meta(ge=1)], ...]


class ModelSpec(_Strict, frozen=True, omit_defaults=True):
    """The calibrated model file and the inference engine that it was calibrated with.

    In 8 bits, results of different engines differ by more than rounding errors, so thresholds are
    valid for one engine only.
    """

    file: Literal["model.onnx"]
    sha256: Sha256
    opset: Annotated[int, Meta(ge=1)]
    precision: Precision
    inputs: tuple[TensorSpec, ...]
    outputs: tuple[TensorSpec, ...]
    provider: Provider = "onnxruntime"


class PreprocessSpec(_Strict, frozen=True, omit_defaults=True):
    """Conversion of a camera image to the model's input; ``in_graph`` lists steps in the model.

    The model computes (value - mean) / std per channel, in RGB order and NCHW layout. ``mean`` and
    ``std`` are null for a network supplied as an ONNX file that contains its own normalisation.
    ``decode``: ``half`` for JPEG images that are decoded to half their height and width; thresholds
    are then valid for those pixels only.
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
    decode: Decode = "full"

    def check_halves(self, height: int, width: int) -> None:
        """Raise UsageError unless half an image is whole pixels, and as many as the model needs."""
        if height % 2 or width % 2 or height < 2 * self.height or width < 2 * self.width:
            raise UsageError(
                "decode: expected images with even sides, at least twice the model's input of "
                f"{self.width}x{self.height}, to decode them at half size, found {width}x{height}"
            )


StillDof = Literal["tx", "ty", "tz", "rx", "ry", "rz"]


class PoseLimits(_Strict, frozen=True):
    """Lowest and highest plausible value per DoF; poses outside them are invalid.

    The limits apply in the chart of the pose. With ``tangent_predicted``, where every prediction
    has zero rotation coordinates, they apply in the tangent space at ``reference_q_xyzw``; if that
    is null, they do not restrict the rotation.
    """

    lowest: Six
    highest: Six


class PoseSpec(_Strict, frozen=True, omit_defaults=True):
    """Meaning, reference frames and units of the six pose coordinates.

    ``origin_m``: the world position that the model's outputs, the limits and the method's
    parameters are relative to; null means the world's own origin. Positions far from it would lose
    centimetres in float32. ``Odometer`` adds it in float64, so its estimates are world coordinates.

    ``still``: the degrees of freedom that hardly moved in training, e.g. the height of a wheeled
    robot. Their ``standard_deviation`` is a floor, and scores leave them out.
    """

    target: Literal["absolute"]
    frame_id: Text
    child_frame_id: Text
    rotation: Rotation
    reference_q_xyzw: Quaternion | None
    units: tuple[Literal["m"], Literal["rad"]]
    limits: PoseLimits
    standard_deviation: SixPositive
    origin_m: Position | None = None
    still: tuple[StillDof, ...] = ()


class LeftOut(_Strict, frozen=True):
    """Coverage of each calibration recording by thresholds from the others, over recordings.

    ``coverage`` is the mean over recordings of the share of frames inside, in the marginal scope
    averaged over the DoF; ``standard_error`` is that mean's, from the recordings' deviation.
    """

    coverage: Annotated[float, Meta(ge=0, le=1)]
    standard_error: Annotated[float, Meta(ge=0, le=1)]


class Threshold(_Strict, frozen=True, omit_defaults=True):
    """q_hat for one confidence and scope; null means unbounded.

    With a two-sided score, ``q_hat`` belongs to the lower side and ``q_hat_upper`` to the upper
    side. With other scores, ``q_hat_upper`` is null. ``left_out`` is null for a single recording,
    and where the threshold without one of the recordings is unbounded.
    """

    confidence: Annotated[float, Meta(gt=0, le=1 - 1e-9)]
    scope: Scope
    q_hat: SixOrUnbounded
    q_hat_upper: SixOrUnbounded | None
    left_out: LeftOut | None = None


# The quantiles of one degree of freedom and side at ascending confidences.
Column = tuple[NumberOrNone, ...]


class QuantileTable(_Strict, frozen=True):
    """Thresholds at ascending ``confidences``, see ``cvo_edge.bundle.quantiles``.

    Each scope has six columns, twelve with two sides (lower ones first), or one for each side if
    all six are equal; a column is null if it is unbounded at every confidence.
    """

    confidences: Annotated[
        tuple[Annotated[float, Meta(gt=0, le=1 - 1e-9)], ...], Meta(min_length=1)
    ]
    marginal: tuple[Column | None, ...]
    joint: tuple[Column | None, ...]


class SplitSpec(_Strict, frozen=True):
    """Assignment of frames to roles, so that the test frames can be reproduced.

    ``purpose``: ``training`` assigns all five roles; ``calibration`` assigns only val, cal and
    test, on data that the network has not seen.
    """

    purpose: Literal["training", "calibration"]
    kind: SplitKind
    seed: Annotated[int, Meta(ge=0)]
    sha256: Sha256


class CalibrationSpec(_Strict, frozen=True, omit_defaults=True):
    """Data and rules that the thresholds were computed with.

    ``rule`` says what counts as one draw; ``cap``, of the rule ``capped`` only, is the share of
    missed frames that a recording counts at most. ``joint`` says how the joint scope combines six
    scores: ``max`` takes the largest one after scaling them on val; ``bonferroni`` uses six
    thresholds, each at a sixth of the miscoverage.

    ``crossed``: number of folds of recordings of a crossed calibration. The scores of each fold
    come from a network trained without it; the bundle's network was trained on all of them.
    """

    score: Text
    joint: Joint
    rule: Rule
    n: Annotated[int, Meta(ge=1, le=10**9)]
    n_sequences: Annotated[int, Meta(ge=1, le=10**9)]
    n_effective: Positive
    split: SplitSpec
    dataset: Text
    cap: Annotated[float, Meta(gt=0, le=1)] | None = None
    crossed: Annotated[int, Meta(ge=2, le=10**9)] | None = None


class AlarmSpec(_Strict, frozen=True, omit_defaults=True):
    """Usual values, scales and limits of the five statistics of a frame, see ``STATISTICS``.

    ``kind``: whether single frames or running statistics of recordings are limited; ``n``: how many
    frames or recordings the limits come from. ``limits`` are in units of ``scales``.
    ``recordings``: the mean novelty of each calibration recording, as records would give it with
    limits from the others; null for single frames, one recording, and in earlier bundles.
    """

    kind: Literal["frames", "recordings"]
    usual: Five
    scales: FivePositive
    limits: FivePositive
    n: Annotated[int, Meta(ge=1, le=10**9)]
    recordings: tuple[Number, ...] | None = None


class DifficultySpec(_Strict, frozen=True):
    """How the novelty of a frame scales its sets, see ``cvo_edge.heads.difficulty``.

    log u = bias + weights . log(novelty), kept between ``lowest`` and ``highest``.
    """

    weights: tuple[Number, Number, Number, Number]
    bias: Number
    lowest: Annotated[float, Meta(ge=-MOST_DIFFICULTY, le=0)]
    highest: Annotated[float, Meta(ge=0, le=MOST_DIFFICULTY)]


class SelfTest(_Strict, frozen=True):
    """A synthetic image from an integer recipe, and the outputs expected for it."""

    recipe: Literal["ripples-1"]
    height: Annotated[int, Meta(ge=16, le=4096)]
    width: Annotated[int, Meta(ge=16, le=4096)]
    outputs: dict[Text, tuple[Number, ...]]
    tolerance: Annotated[float, Meta(gt=0, le=1)]


class Provenance(_Strict, frozen=True):
    """How the bundle was made: names and digests, never a path.

    ``backbone`` and ``training_split`` are null for a network supplied as an ONNX file.
    Recalibration keeps ``training_split``, because it tells which frames the network has seen.
    """

    created_with: dict[Text, Text]
    seed: Annotated[int, Meta(ge=0)]
    backbone: Text | None
    weights_sha256: Sha256 | None
    dataset: Text
    training_split: SplitSpec | None
    options: dict[Text, Text | int | float | bool | None]


class ImageSpec(_Strict, frozen=True):
    """The calibration images, as they were before preprocessing.

    ``width``, ``height``: their size in pixels. ``colour``: whether they have colour, but for a few
    that count as flagged; images without it are then doubted.
    """

    width: Annotated[int, Meta(ge=LEAST_SIDE, le=100_000)]
    height: Annotated[int, Meta(ge=LEAST_SIDE, le=100_000)]
    colour: bool


Version = Literal[1, 2, 3]


class Calibration(_Strict, frozen=True, omit_defaults=True):
    """The contents of ``calibration.json``; see ``version_of`` for its version.

    ``camera``: intrinsics of the calibration images' camera; null if the data set does not state
    them. ``images``: their size and colour; null in bundles of earlier releases. ``alarm``: when a
    stream's images are no longer like those of the calibration; null if the graph does not tell.
    ``difficulty``: what scales the sets of the thresholds from frame to frame; null for nothing.
    ``quantiles``: thresholds at many more confidences; null in bundles of earlier releases.
    """

    schema_version: Version
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
    camera: Camera | None = None
    images: ImageSpec | None = None
    alarm: AlarmSpec | None = None
    difficulty: DifficultySpec | None = None
    quantiles: QuantileTable | None = None

    def threshold(self, confidence: float, scope: Scope) -> Threshold | None:
        """Return the stored threshold for this confidence and scope, or None.

        Confidences match within 1e-7, so single-precision values are found, too.
        """
        for entry in self.thresholds:
            if entry.scope == scope and math.isclose(
                entry.confidence, confidence, abs_tol=SAME_CONFIDENCE
            ):
                return entry
        return None

    def confidences(self, scope: Scope) -> tuple[float, ...]:
        """Return the confidences stored for this scope, ascending."""
        return tuple(sorted(entry.confidence for entry in self.thresholds if entry.scope == scope))

    def parameters(self, kind: type[Parameters]) -> Parameters:
        """Return ``method_parameters`` as the method's own struct.

        Raises CalibrationFileError if they belong to another method or are out of range.
        """
        try:
            return msgspec.convert(self.method_parameters, kind, strict=True)
        except msgspec.ValidationError as error:
            raise CalibrationFileError(f"method_parameters: {one_line(str(error))}") from None


def version_of(inputs: PreprocessSpec, quantiles: QuantileTable | None) -> Version:
    """Return the version: 3 for images decoded at half size, 2 with quantiles, 1 for others."""
    return 3 if inputs.decode == "half" else 1 if quantiles is None else 2
