"""The format of ``motion.json``: one typed struct for each of its objects, and how it is read."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta, Struct
from numpy.typing import NDArray

from cvo_edge.bundle.format import Number, Positive, Quaternion, Sha256, Text
from cvo_edge.documents import UNWRITTEN, decode_document, encode_document, shown
from cvo_edge.errors import CalibrationFileError, UsageError
from cvo_edge.files import read_regular_file
from cvo_edge.motion.horizons import Horizon
from cvo_edge.motion.thresholds import is_supported
from cvo_edge.motion.trace import LAGS, scale_width, tube_width
from cvo_edge.vocabulary import MOTION_RULES, VERSION, MotionRule

SCHEMA_VERSION = 1
MAX_BYTES = 64 * 1024
# Errors with a threshold: six degrees of freedom, position and rotation as a whole, and all six
# degrees of freedom at once.
COLUMNS = ("tx", "ty", "tz", "rx", "ry", "rz", "position", "rotation", "joint")
LEVELS = (0.5, 0.8, 0.9, 0.95, 0.99)
# Four digits are kept.
_ROUNDING = 0.01
BIAS_WIDTH = 1 + 6 * (1 + LAGS)

_Count = Annotated[int, Meta(ge=1)]
# Thresholds are rounded upwards: even those of errors that are all zero are above it.
_Threshold = Annotated[float, Meta(gt=0, lt=1e9)]
_Form = Annotated[str, Meta(pattern=r"^[0-9.]{1,12}[fsm]$(?!\n)")]


class _Strict(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Immutable; keys without a default are required, unknown keys are an error."""


class LimitsSpec(_Strict, frozen=True):
    """What breaks a trajectory, see ``trace.Limits``."""

    period_s: Positive
    gap_s: Positive
    speed: Positive
    turn: Positive


class CorrectionSpec(_Strict, frozen=True):
    """What was corrected before the calibration, and has to be in an audit.

    ``time``: each truth was moved by its own time offset, whose median is ``offset_s``. ``frame``:
    ``q_xyzw`` leads from the estimate's body frame to the truth's. ``scale``: the estimate's
    translations were multiplied by it. null: not corrected.
    """

    offset_s: Number | None
    q_xyzw: Quaternion | None
    scale: Positive | None


class ScaleSpec(_Strict, frozen=True):
    """Coefficients U (k, 8) and the range of their numbers, see ``fitting``."""

    coefficients: tuple[tuple[Number, ...], ...]
    lowest: tuple[Number, ...]
    highest: tuple[Number, ...]


class ThresholdSpec(_Strict, frozen=True):
    """Thresholds for the errors of ``COLUMNS``; null is unbounded."""

    rule: MotionRule
    confidence: Annotated[float, Meta(gt=0, lt=1)]
    q: tuple[_Threshold | None, ...]


class HorizonSpec(_Strict, frozen=True):
    """A horizon: how many recordings and motions it is calibrated on, bias, scale, thresholds.

    ``joint``: thresholds of the six degrees of freedom that the joint score is measured in.
    ``shape``: lower triangle, row by row, of the covariance of scaled residuals (``covariance``).
    ``usual``: mean scale of each error; a threshold times it is a usual half-width or radius.
    """

    horizon: _Form
    recordings: _Count
    motions: _Count
    bias: tuple[tuple[Number, ...], ...] | None
    scale: ScaleSpec | None
    joint: tuple[_Threshold, ...]
    usual: tuple[Positive, ...]
    shape: tuple[Number, ...]
    thresholds: tuple[ThresholdSpec, ...]


class TubeThresholdSpec(_Strict, frozen=True):
    """Thresholds for position, rotation and all six degrees of freedom; null is unbounded."""

    rule: MotionRule
    confidence: Annotated[float, Meta(gt=0, lt=1)]
    q: tuple[_Threshold | None, _Threshold | None, _Threshold | None]


class WindowSpec(_Strict, frozen=True):
    """A window and its tube, see ``windows``: scale and thresholds on scores.

    ``recordings`` and ``anchors``: how many it is calibrated on.
    ``unit``: thresholds of the six degrees of freedom that the score of all six is measured in.
    ``usual``: mean scale of each error at the end of the window.
    """

    window: _Form
    recordings: _Count
    anchors: _Count
    scale: ScaleSpec
    unit: tuple[Positive, ...]
    usual: tuple[Positive, ...]
    thresholds: tuple[TubeThresholdSpec, ...]


class FamiliarSpec(_Strict, frozen=True):
    """Mean and spread of what the estimate says of its motion, and the limit, see ``drift``."""

    mean: tuple[Number, ...]
    spread: tuple[Positive, ...]
    limit: Positive


class RecordingSpec(_Strict, frozen=True):
    """A recording of the calibration: its drive, poses with a truth, seconds and metres."""

    name: Text
    group: Text
    poses: _Count
    seconds: Positive
    metres: Annotated[float, Meta(ge=0, lt=1e9)]


class MotionFile(_Strict, frozen=True, kw_only=True):
    """``motion.json``: intervals on the relative motion of one estimator.

    Attributes
    ----------
    kind, schema_version, digest, software
        What the file is, and the program that wrote it.
    name
        Estimator and vehicle, in the words of who calibrated.
    translation
        ``direction``: the estimator has no scale. Numbers of position are then angles in rad
        between directions, and those of tx, ty and tz mean nothing, see ``direction``.
    limits, correction
        See there.
    columns
        Names of columns of the estimate's file that the scale uses.
    recordings
        Those that were used, the first 100 of them.
    groups
        The number of drives; that is what the rules count.
    familiar
        See there.
    integrated
        Factors of the covariance of that name, see ``covariance``; null without the horizon 1f.
    horizons, windows
        One or more horizons, each once; any number of windows.
    """

    kind: Literal["motion"] = "motion"
    schema_version: Literal[1] = 1
    digest: Sha256 = UNWRITTEN
    software: Text = f"cvo-edge {VERSION}"
    name: Text
    translation: Literal["metres", "direction"] = "metres"
    limits: LimitsSpec
    correction: CorrectionSpec
    columns: tuple[Text, ...]
    groups: _Count
    recordings: tuple[RecordingSpec, ...]
    familiar: FamiliarSpec
    integrated: tuple[Positive, Positive, Positive, Positive, Positive, Positive] | None
    horizons: tuple[HorizonSpec, ...]
    windows: tuple[WindowSpec, ...]


def read_motion_file(path: Path) -> MotionFile:
    """Read and check ``motion.json``; raises CalibrationFileError."""
    content = read_regular_file(path, MAX_BYTES, CalibrationFileError)
    return decode_motion_file(content, str(path))


def decode_motion_file(content: bytes, where: str = "motion.json") -> MotionFile:
    """Parse and check the bytes of ``motion.json``; raises CalibrationFileError."""
    return decode_document(content, MotionFile, (SCHEMA_VERSION,), where, _check)


def encode_motion_file(file: MotionFile) -> bytes:
    """Return the file's bytes, with the digest filled in; raises CalibrationFileError."""
    content = encode_document(file, MAX_BYTES, "motion.json", dense=True)
    decode_motion_file(content)
    return content


def _check(file: MotionFile) -> None:
    """Raise CalibrationFileError, naming the key and the rule, if keys contradict each other."""
    horizons = [spec.horizon for spec in file.horizons]
    if not horizons or len(set(horizons)) != len(horizons):
        raise CalibrationFileError(f"horizons: expected each once, found {shown(horizons)}")
    windows = [spec.window for spec in file.windows]
    if len(set(windows)) != len(windows):
        raise CalibrationFileError(f"windows: expected each once, found {shown(windows)}")
    for window in file.windows:
        where = f"window {window.window}"
        _check_name(where, window.window)
        _check_scale(where, window.scale, tube_width(len(file.columns)))
        _check_shape(f"{where}: unit", [window.unit], (1, 6))
        _check_shape(f"{where}: usual", [window.usual], (1, 8))
        _check_thresholds(where, window.thresholds, 3)
        _check_counts(where, file.groups, window.recordings, window.anchors)
        _check_supported(where, window.thresholds, window.recordings)
    sizes = 4 + len(file.columns)
    _check_shape("familiar", [file.familiar.mean, file.familiar.spread], (2, sizes))
    width, pointed = scale_width(len(file.columns)), file.translation == "direction"
    for spec in file.horizons:
        where = f"horizon {spec.horizon}"
        _check_name(where, spec.horizon)
        _check_shape(f"{where}: bias", spec.bias, (BIAS_WIDTH, 6))
        if spec.scale is not None:
            _check_scale(where, spec.scale, width)
        _check_shape(f"{where}: joint", [spec.joint], (1, 6))
        _check_shape(f"{where}: usual", [spec.usual], (1, 8))
        _check_shape(f"{where}: shape", [spec.shape], (1, 21))
        if not _positive(symmetric(spec.shape)):
            raise CalibrationFileError(f"{where}: shape: expected a positive definite matrix")
        _check_thresholds(where, spec.thresholds, len(COLUMNS))
        _check_counts(where, file.groups, spec.recordings, spec.motions)
        _check_supported(where, spec.thresholds, spec.recordings, pointed=pointed)
        _check_all_six(where, spec)
    quaternion = file.correction.q_xyzw
    if quaternion is not None and abs(sum(each**2 for each in quaternion) - 1.0) > 1e-6:
        raise CalibrationFileError(
            f"correction.q_xyzw: expected a unit quaternion, found {shown(quaternion)}"
        )


def symmetric(triangle: Sequence[float]) -> NDArray[np.float64]:
    """Return the symmetric matrix (6, 6) of a lower triangle, row by row."""
    matrix = np.zeros((6, 6))
    matrix[np.tril_indices(6)] = triangle
    return np.asarray(matrix + np.tril(matrix, -1).T)


def _positive(matrix: NDArray[np.float64]) -> bool:
    """Whether a matrix is positive definite; units of its rows may differ by orders."""
    variances = np.diag(matrix)
    if not (variances > 0.0).all():
        return False
    return bool(np.linalg.eigvalsh(matrix / np.sqrt(np.outer(variances, variances)))[0] > 0.0)


def _check_name(where: str, name: str) -> None:
    try:
        plain = str(Horizon.parse(name)) == name
    except UsageError:
        plain = False
    if not plain:
        raise CalibrationFileError(f"{where}: expected e.g. 1f, 5s or 100m")


def _check_scale(where: str, scale: ScaleSpec, width: int) -> None:
    _check_shape(f"{where}: scale.coefficients", scale.coefficients, (1 + width, 8))
    for key in ("lowest", "highest"):
        _check_shape(f"{where}: scale.{key}", [getattr(scale, key)], (1, width))


def _check_shape(
    where: str, rows: Sequence[Sequence[object]] | None, shape: tuple[int, int]
) -> None:
    if rows is None:
        return
    found = {len(row) for row in rows}
    if len(rows) != shape[0] or found != {shape[1]}:
        raise CalibrationFileError(
            f"{where}: expected {shape[0]} x {shape[1]} numbers, found {len(rows)} x "
            f"{shown(sorted(found))}"
        )


def _check_thresholds(
    where: str, thresholds: Sequence[ThresholdSpec | TubeThresholdSpec], columns: int
) -> None:
    for rule in MOTION_RULES:
        entries = [each for each in thresholds if each.rule == rule]
        levels = [each.confidence for each in entries]
        if levels != list(LEVELS):
            raise CalibrationFileError(
                f"{where}: expected thresholds of {rule} at {shown(LEVELS)}, found {shown(levels)}"
            )
        _check_shape(f"{where}: q", [each.q for each in entries], (len(LEVELS), columns))
        for low, high in pairwise(entries):
            rising = zip(low.q, high.q, strict=True)
            if any(
                (b if b is not None else 1e9) < (a if a is not None else 1e9) for a, b in rising
            ):
                raise CalibrationFileError(
                    f"{where}: expected thresholds of {rule} that do not fall from "
                    f"{low.confidence:g} to {high.confidence:g}"
                )


def _check_counts(where: str, groups: int, recordings: int, motions: int) -> None:
    if not recordings <= min(groups, motions):
        raise CalibrationFileError(
            f"{where}: expected at most {groups} drives, each with motions, found {recordings} "
            f"with {motions}"
        )


def _check_supported(
    where: str,
    thresholds: Sequence[ThresholdSpec | TubeThresholdSpec],
    count: int,
    *,
    pointed: bool = False,
) -> None:
    """Check that thresholds are finite exactly if the drives allow it, and grow by the rules.

    Where only directions are known, the first three columns mean nothing, and that of the position
    is the direction's: not all drives have one.
    """
    least: dict[tuple[float, int], tuple[str, float]] = {}
    for rule in ("mean", "tolerance", "capped", "hierarchical"):
        for entry in (each for each in thresholds if each.rule == rule):
            finite = is_supported(rule, entry.confidence, count)
            for column, value in enumerate(entry.q):
                if pointed and value is None and column == COLUMNS.index("position"):
                    continue
                if (value is not None) != (finite and not (pointed and column < 3)):
                    raise CalibrationFileError(
                        f"{where}: expected {'a number' if finite else 'null'} for {rule} at "
                        f"{entry.confidence:g} from {count} drives, found {shown(value)} at "
                        f"[{column}]"
                    )
                key, found = (entry.confidence, column), math.inf if value is None else value
                other, low = least.get(key, ("", 0.0))
                if found < low:
                    raise CalibrationFileError(
                        f"{where}: expected {rule} to be at least {other} at "
                        f"{entry.confidence:g}, {low:g}, found {found:g} at [{column}]"
                    )
                if rule != "tolerance":
                    least[key] = rule, found


def _check_all_six(where: str, spec: HorizonSpec) -> None:
    """Check that a set of all six degrees of freedom is as wide as that of each."""
    for entry in spec.thresholds:
        together = entry.q[COLUMNS.index("joint")]
        for column, unit in enumerate(spec.joint):
            alone = entry.q[column]
            if together is None or alone is None:
                continue
            if together * unit < alone * (1.0 - _ROUNDING):
                raise CalibrationFileError(
                    f"{where}: expected joint thresholds of at least those of {COLUMNS[column]}, "
                    f"{alone:g}, found {together * unit:g} for {entry.rule} at "
                    f"{entry.confidence:g}"
                )
