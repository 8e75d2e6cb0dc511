"""The bundle: ``calibration.json`` as typed structs, strict reading, writing, digests.

Both sides of the project read and write bundles through this module alone. The README specifies
the format key by key; every refusal here is one line that names the key and the rule.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import msgspec
from msgspec import Meta, Struct

from cvo_edge.errors import BundleMismatchError, CalibrationFileError, ModelError
from cvo_edge.files import read_regular_file, regular_file
from cvo_edge.pose import Rotation, Scope
from cvo_edge.preprocess import Crop

SCHEMA_VERSION = 1
CALIBRATION_FILE = "calibration.json"
MODEL_FILE: Literal["model.onnx"] = "model.onnx"
MAX_CALIBRATION_BYTES = 64 * 1024
MAX_MODEL_BYTES = 1 << 30
MAX_DEPTH = 16
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
MethodName = Literal["cqr", "csp", "mcqr", "cjp"]
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
    joint: Literal["max", "bonferroni"]
    rule: Literal["pooled", "hierarchical", "weighted"]
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
    method: MethodName
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
            if entry.scope == scope and math.isclose(entry.confidence, confidence, abs_tol=1e-9):
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
            raise CalibrationFileError(f"method_parameters: {_one_line(str(error))}") from None


@dataclass(frozen=True)
class Bundle:
    """A bundle in memory: the calibration and the very bytes whose sha256 it names."""

    calibration: Calibration
    model_bytes: bytes


# What else may speak against a bundle: its folder, its calibration, the bytes it was read from.
Check = Callable[[Path, Calibration, bytes], None]

# -- reading ------------------------------------------------------------------------------------


def read_bundle(folder: Path, check: Check | None = None) -> Bundle:
    """Read and check a bundle folder; the model's bytes are read once and match their digest.

    With a ``check``, e.g. of a signature, that as well.

    Raises
    ------
    CalibrationFileError
        ``calibration.json`` is missing, no regular file, malformed or altered.
    ModelError
        ``model.onnx`` is missing, no regular file or too large.
    BundleMismatchError
        The model is not the one that was calibrated; and what the check raises.
    """
    calibration = read_calibration(folder, check)
    path = folder / MODEL_FILE
    model_bytes = read_regular_file(path, MAX_MODEL_BYTES, ModelError)
    _check_model_digest(path, hashlib.sha256(model_bytes).hexdigest(), calibration)
    return Bundle(calibration, model_bytes)


def check_model_file(folder: Path, calibration: Calibration) -> None:
    """Raise as ``read_bundle`` where a model file is not the calibrated one, keeping none of it."""
    path = folder / MODEL_FILE
    with regular_file(path, MAX_MODEL_BYTES, ModelError) as stream:
        try:
            found = hashlib.file_digest(stream, "sha256").hexdigest()
        except OSError as failure:
            raise ModelError(f"{path}: cannot be read: {failure.strerror}") from None
    _check_model_digest(path, found, calibration)


def _check_model_digest(path: Path, found: str, calibration: Calibration) -> None:
    if found != calibration.model.sha256:
        raise BundleMismatchError(
            f"{path}: expected sha256 {calibration.model.sha256} (from {CALIBRATION_FILE}), "
            f"found {found}"
        )


def read_calibration(folder: Path, check: Check | None = None) -> Calibration:
    """Read and check ``calibration.json`` of a bundle folder.

    Raises CalibrationFileError, and what a ``check`` raises.
    """
    # Not is_dir(): a name that is too long is none, either.
    if not os.path.isdir(folder):  # noqa: PTH112
        raise CalibrationFileError(f"{folder}: expected a bundle folder, found none")
    path = folder / CALIBRATION_FILE
    content = read_regular_file(path, MAX_CALIBRATION_BYTES, CalibrationFileError)
    calibration = decode_calibration(content, str(path))
    if check is not None:
        check(folder, calibration, content)
    return calibration


def decode_calibration(content: bytes, where: str = CALIBRATION_FILE) -> Calibration:
    """Bytes of ``calibration.json`` -> Calibration; ``where`` names them in errors.

    The order of the checks is that of the trust they need: encoding, JSON, version, digest,
    structure, then the rules between keys. Raises CalibrationFileError.
    """
    try:
        document = _parse_json(content)
        version = document.get("schema_version")
        if type(version) is not int or version != SCHEMA_VERSION:
            raise CalibrationFileError(
                f"schema_version: expected {SCHEMA_VERSION}, found {_shown(version)}; "
                "a newer file needs a newer cvo-edge"
            )
        _check_digest(content)
        calibration = msgspec.convert(document, Calibration, strict=True)
        _check_rules(calibration)
        # JSON can say half of a surrogate pair, which nobody can print.
        json.dumps(document, ensure_ascii=False).encode()
    except UnicodeEncodeError:
        raise CalibrationFileError(f"{where}: expected characters, found half of one") from None
    except CalibrationFileError as error:
        raise CalibrationFileError(f"{where}: {error}") from None
    except msgspec.ValidationError as error:
        raise CalibrationFileError(f"{where}: {_one_line(str(error))}") from None
    return calibration


def _parse_json(content: bytes) -> dict[str, Any]:
    """Strict JSON: UTF-8 without BOM, one object, no duplicate key, every number finite."""
    if content.startswith(b"\xef\xbb\xbf"):
        raise CalibrationFileError("expected UTF-8 without a byte order mark, found one")
    if _depth(content) > MAX_DEPTH:
        raise CalibrationFileError(f"expected at most {MAX_DEPTH} nested levels, found more")
    try:
        document = json.loads(
            content.decode("utf-8"),
            object_pairs_hook=_without_duplicates,
            parse_constant=_refuse_constant,
            parse_float=_finite_float,
            parse_int=_bounded_int,
        )
    except UnicodeDecodeError as error:
        raise CalibrationFileError(
            f"expected UTF-8, found byte {error.start} that is not"
        ) from None
    except json.JSONDecodeError as error:
        raise CalibrationFileError(
            f"expected JSON, found an error in line {error.lineno} column {error.colno}: "
            f"{error.msg}"
        ) from None
    if not isinstance(document, dict):
        raise CalibrationFileError(f"expected one JSON object, found {type(document).__name__}")
    return document


def _depth(content: bytes) -> int:
    """Deepest nesting of brackets, counted before parsing; brackets in strings count as well."""
    deepest = depth = 0
    for byte in content:
        if byte in b"[{":
            depth += 1
            deepest = max(deepest, depth)
        elif byte in b"]}":
            depth -= 1
    return deepest


def _without_duplicates(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    keys: dict[str, Any] = {}
    for key, value in pairs:
        if key in keys:
            raise CalibrationFileError(f"expected each key once, found {_shown(key)} twice")
        keys[key] = value
    return keys


def _refuse_constant(name: str) -> float:
    raise CalibrationFileError(f"expected finite numbers, found {name}")


def _finite_float(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise CalibrationFileError(f"expected finite numbers, found {_shown(text)}")
    return value


def _bounded_int(text: str) -> int:
    if len(text) > 20:
        raise CalibrationFileError(f"expected at most 20 digits, found a number of {len(text)}")
    return int(text)


def _shown(value: object) -> str:
    return _one_line(repr(value))


def _one_line(text: str) -> str:
    line = " ".join(text.split())
    return line if len(line) <= 160 else line[:157] + "..."


# -- the rules between keys ---------------------------------------------------------------------


def _check_rules(calibration: Calibration) -> None:
    pose = calibration.pose
    given = pose.reference_q_xyzw is not None
    # An offset about the prediction needs no reference; its plausible limits may.
    if pose.rotation != "tangent_predicted" and given != (pose.rotation == "tangent_reference"):
        raise CalibrationFileError(
            "pose.reference_q_xyzw: expected a quaternion with tangent_reference and null with "
            f"euler_zyx, found {_shown(pose.reference_q_xyzw)} with {pose.rotation}"
        )
    if pose.reference_q_xyzw is not None:
        norm = math.sqrt(sum(component**2 for component in pose.reference_q_xyzw))
        if abs(norm - 1.0) > 1e-6:
            raise CalibrationFileError(
                f"pose.reference_q_xyzw: expected norm 1 within 1e-6, found {norm:.9g}"
            )
    for index, (low, high) in enumerate(zip(pose.limits.lowest, pose.limits.highest, strict=True)):
        if not low < high:
            raise CalibrationFileError(
                f"pose.limits: expected lowest < highest, found {low} and {high} at [{index}]"
            )
    _check_thresholds(calibration.thresholds)
    _check_model(calibration)


def _check_thresholds(thresholds: tuple[Threshold, ...]) -> None:
    for scope in ("marginal", "joint"):
        stored = [entry.confidence for entry in thresholds if entry.scope == scope]
        missing = [c for c in CONFIDENCES if not any(abs(c - found) < 1e-9 for found in stored)]
        if missing:
            raise CalibrationFileError(
                f"thresholds: expected {', '.join(map(str, CONFIDENCES))} for scope {scope}, "
                f"found none for {', '.join(map(str, missing))}"
            )
        entries = sorted(
            (entry for entry in thresholds if entry.scope == scope), key=lambda e: e.confidence
        )
        for before, after in pairwise(entries):
            if after.confidence - before.confidence < 1e-9:
                raise CalibrationFileError(
                    f"thresholds: expected each confidence once a scope, found "
                    f"{after.confidence} ({scope}) twice"
                )
            for side in ("q_hat", "q_hat_upper"):
                _check_monotone(getattr(before, side), getattr(after, side), side, after, scope)


def _check_monotone(
    smaller: SixOrUnbounded | None,
    larger: SixOrUnbounded | None,
    side: str,
    entry: Threshold,
    scope: str,
) -> None:
    if smaller is None or larger is None:
        if smaller is not larger:
            raise CalibrationFileError(f"thresholds.{side}: expected null for all or for none")
        return
    for index, (low, high) in enumerate(zip(smaller, larger, strict=True)):
        # None is unbounded, the largest of all.
        if high is not None and (low is None or low > high):
            raise CalibrationFileError(
                f"thresholds.{side}: expected growth with the confidence, found {low} before "
                f"{high} at [{index}], confidence {entry.confidence}, {scope}"
            )


def _check_model(calibration: Calibration) -> None:
    model, preprocess = calibration.model, calibration.preprocess
    image = TensorSpec(
        name="image", dtype="uint8", shape=(1, preprocess.height, preprocess.width, 3)
    )
    if image not in model.inputs:
        raise CalibrationFileError(
            f"model.inputs: expected image uint8 {list(image.shape)} (from preprocess), found "
            + _shown([(spec.name, spec.dtype, list(spec.shape)) for spec in model.inputs])
        )
    for tensors in (model.inputs, model.outputs):
        names = [spec.name for spec in tensors]
        if len(set(names)) != len(names):
            raise CalibrationFileError(f"model: expected each tensor once, found {_shown(names)}")
    sizes = {spec.name: math.prod(spec.shape) for spec in model.outputs}
    given = {name: len(values) for name, values in calibration.selftest.outputs.items()}
    if sizes != given:
        raise CalibrationFileError(
            f"selftest.outputs: expected one value per element of model.outputs {_shown(sizes)}, "
            f"found {_shown(given)}"
        )


# -- writing ------------------------------------------------------------------------------------

_DIGEST = re.compile(rb'"digest"\s*:\s*"([0-9a-f]{64})"')


def encode_calibration(calibration: Calibration) -> bytes:
    """Calibration -> the bytes of ``calibration.json`` with its own digest filled in.

    What was written is read back before it is returned, so that nothing the reader would refuse
    is ever written. Raises CalibrationFileError.
    """
    blank = msgspec.structs.replace(calibration, digest="0" * 64)
    text = json.dumps(msgspec.to_builtins(blank), indent=1, ensure_ascii=False, allow_nan=False)
    # One line a list of numbers: the file is read by people, too.
    text = re.sub(r"\[\s+([^\[\]{}\"]*?)\s+\]", _joined, text) + "\n"
    content = text.encode("utf-8")
    start, stop = _digest_span(content)
    digest = hashlib.sha256(content).hexdigest().encode()
    content = content[:start] + digest + content[stop:]
    if len(content) > MAX_CALIBRATION_BYTES:
        raise CalibrationFileError(
            f"{CALIBRATION_FILE}: expected at most {MAX_CALIBRATION_BYTES} bytes, "
            f"found {len(content)}"
        )
    decode_calibration(content)
    return content


def _joined(match: re.Match[str]) -> str:
    return "[" + " ".join(match.group(1).split()) + "]"


def _digest_span(content: bytes) -> tuple[int, int]:
    # A quotation mark inside a JSON string is escaped, so only real keys match.
    spans = [match.span(1) for match in _DIGEST.finditer(content)]
    if len(spans) != 1:
        raise CalibrationFileError(
            f"digest: expected one key with 64 hexadecimal digits, found {len(spans)}"
        )
    return spans[0]


def _check_digest(content: bytes) -> None:
    start, stop = _digest_span(content)
    blank = content[:start] + b"0" * 64 + content[stop:]
    expected = hashlib.sha256(blank).hexdigest()
    found = content[start:stop].decode("ascii")
    if found != expected:
        raise CalibrationFileError(
            f"digest: expected {expected} for these bytes, found {found}; the file was altered"
        )
