"""Scene coordinates and a regressed pose, fused: precise in new places and on known frames.

The errors of scene coordinate regression (``cvo_edge.heads.scr``) and of a network that regresses
the pose hardly correlate, so that both together know more than each. With the solver's information
H and the regression's half-widths h, both scaled on val, the fused pose minimises

    e^T kappa H e  +  share (e - d)^T diag(1 / (rho h)^2) (e - d)

where d is the regression's offset (t_r - t_s, Log(R_s^T R_r)) from the solved pose. Where the two
disagree by more than their deviations, the covariance grows by the Birge ratio (Birge 1932). The
network that regresses has learned one camera: with another one, it is left out.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar

import numpy as np
from msgspec import Meta, Struct
from msgspec.structs import replace
from numpy.typing import NDArray

from cvo_edge import geometry
from cvo_edge.bundle.format import Positive, SixPositive
from cvo_edge.conformal import conformal_quantile, interval_score
from cvo_edge.heads.base import Candidate
from cvo_edge.heads.scr import LOST, ScrHead, ScrParameters
from cvo_edge.input.view import SeenCamera
from cvo_edge.pose import Chart

Array = NDArray[np.float64]

_CHART = Chart("tangent_predicted")
# Shares of the regression's information that val chooses from.
_SHARES = (0.0, 0.1, 0.3, 1.0)
# The regression has a part only if it lowers val's score by this share: between known frames it
# does by 31 % to 42 %, on new recordings by 2 % to 5 %, which their test frames do not confirm.
_CLEARLY = 0.1
_MEDIAN_CHI2_6 = 5.348
# The limit of the disagreement over the largest of the known frames: a new recording has frames
# that are a little harder.
_DISAGREEMENT_MARGIN = 1.3


class Fusion(Struct, frozen=True, forbid_unknown_fields=True):
    """Weights of the two poses, from val.

    ``kappa`` scales the solver's information; ``rho`` (per DoF) makes the regression's half-widths
    standard deviations; ``share`` of the regression's information is used.
    """

    kappa: Positive
    rho: SixPositive
    share: Annotated[float, Meta(ge=0, le=1)]


class FusedParameters(ScrParameters, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``method_parameters`` of a fused bundle: those of SCR and the weights.

    ``fusion`` null uses the solver alone. ``disagreement_limit``: frames whose two poses differ by
    more get no interval; null accepts every frame.
    """

    fusion: Fusion | None
    disagreement_limit: Positive | None


class FusedHead(ScrHead):
    """Score and sets of scene coordinates fused with a regressed pose."""

    method = "fused"
    parameters_type: ClassVar[type[Struct]] = FusedParameters
    parameters: FusedParameters

    def __init__(self, parameters: FusedParameters, score: str) -> None:
        super().__init__(parameters, score)
        self.outputs = {**self.outputs, "regression": (1, 7), "half_width": (1, 6)}

    def combined(
        self,
        outputs: Mapping[str, NDArray[Any]],
        solved: Array,
        information: Array,
        seen: SeenCamera,
    ) -> tuple[Array, Array, dict[str, Array]]:
        """As ``ScrHead``: the fused pose.

        Adds the solver's information ``solved`` (1, 6, 6) and, where both poses are used, their
        ``disagreement`` (1, 1).
        """
        added = {"solved": information[np.newaxis]}
        fusion = self.parameters.fusion
        if fusion is None:
            return solved, information, added
        if fusion.share == 0.0 or not seen.learned:
            return solved, fusion.kappa * information, added
        regression = outputs["regression"][0].astype(np.float64)
        # A zero quaternion is no rotation, and gives NaN.
        regression[3:] /= math.hypot(*regression[3:].tolist()) or math.nan
        pose, information, disagreement = fuse(
            solved, information, regression, outputs["half_width"][0], fusion
        )
        return pose, information, {**added, "disagreement": np.array([[disagreement]])}

    def doubted(self, added: Mapping[str, Array]) -> bool:
        """As ``ScrHead``: the two poses differ more than those of any known frame."""
        limit = self.parameters.disagreement_limit
        if limit is None or "disagreement" not in added:
            return False
        return bool(added["disagreement"][0, 0] > limit)

    def tuned(
        self,
        val: Mapping[str, NDArray[Any]],
        poses: Array,
        known: Mapping[str, NDArray[Any]],
        sequence: NDArray[np.int64],
    ) -> FusedParameters:
        """As ``ScrHead``, and the weights with a clearly better interval score on val, if any."""
        limited = super().tuned(val, poses, known, sequence)
        limits, camera_limits = limited.limits, limited.camera_limits
        regression = np.asarray(val["regression"], np.float64)
        regression[:, 3:] = geometry.quaternion_normalise(regression[:, 3:])
        solved, half_width = val["solved_pose"], np.asarray(val["half_width"], np.float64)
        error = _offset(poses, solved)
        distance = np.einsum("ni,nij,nj->n", error, val["solved"], error)
        kappa = _MEDIAN_CHI2_6 / max(float(np.median(distance)), 1e-9)
        ratio = np.abs(_offset(poses, regression)) / np.maximum(half_width, 1e-12)
        rho = tuple(np.maximum(1.4826 * np.median(ratio, axis=0), 1e-6).tolist())
        choices = [Fusion(kappa, rho, share) for share in _SHARES]
        scores = [
            _score(poses, solved, val["solved"], regression, half_width, fusion)
            for fusion in choices
        ]
        best = int(np.argmin(scores))
        fusion = choices[best if scores[best] < (1.0 - _CLEARLY) * scores[0] else 0]
        return replace(
            self.parameters,
            limits=limits,
            camera_limits=camera_limits,
            fusion=fusion,
            disagreement_limit=_disagreement_limit(known, fusion),
        )

    def candidates(self) -> tuple[Candidate, ...]:
        """As ``ScrHead``; other data need other weights."""
        parameters = replace(
            self.parameters,
            limits=None,
            camera_limits=None,
            fusion=None,
            disagreement_limit=None,
        )
        return (Candidate(self.score, parameters),)


def fuse(
    solved: Array,
    information: Array,
    regression: Array,
    half_width: NDArray[Any],
    fusion: Fusion,
) -> tuple[Array, Array, float]:
    """Solved pose (7,) and information (6, 6), regressed pose (7,) and half-widths (6,) -> fused.

    Returns the pose (7,), its information (6, 6), m and rad, and the disagreement: the squared
    distances of both poses from the fused one in deviations, over six.
    """
    H = fusion.kappa * information
    D = fusion.share / np.square(np.array(fusion.rho) * np.maximum(half_width, 1e-12))
    # As ``_offset``, in a tenth of the time.
    offset = Chart("tangent_reference", solved[3:]).point(regression)
    offset[:3] -= solved[:3]
    total = H + np.diag(D)
    step = np.linalg.solve(total, D * offset)
    rest = offset - step
    disagreement = (float(step @ H @ step) + float(rest @ (D * rest))) / 6.0
    position = (solved[:3] + step[:3]).tolist()
    pose = np.array([*position, *_turned(*solved[3:].tolist(), *step[3:].tolist())])
    return pose, total / max(1.0, disagreement), disagreement


def _turned(
    x: float, y: float, z: float, w: float, a: float, b: float, c: float
) -> tuple[float, float, float, float]:
    """Quaternion x y z w, then the rotation vector a b c, rad, about its axes -> quaternion.

    For one quaternion, plain Python is faster than ``geometry``.
    """
    angle = math.sqrt(a * a + b * b + c * c)
    factor, d = math.sin(0.5 * angle) / angle if angle > 0.0 else 0.5, math.cos(0.5 * angle)
    a, b, c = factor * a, factor * b, factor * c
    return (
        w * a + x * d + y * c - z * b,
        w * b - x * c + y * d + z * a,
        w * c + x * b - y * a + z * d,
        w * d - x * a - y * b - z * c,
    )


def _disagreement_limit(known: Mapping[str, NDArray[Any]], fusion: Fusion) -> float | None:
    """Return the limit of the disagreement, a margin beyond the largest of the located frames."""
    located = known["signs"][:, 1] <= LOST
    if fusion.share == 0.0 or not located.any():
        return None
    regression = np.asarray(known["regression"][located], np.float64)
    regression[:, 3:] = geometry.quaternion_normalise(regression[:, 3:])
    frames = (known["solved_pose"], known["solved"], known["half_width"])
    solved, information, half_width = (values[located] for values in frames)
    found = [
        fuse(*frame, fusion)[2]
        for frame in zip(solved, information, regression, half_width, strict=True)
    ]
    return _DISAGREEMENT_MARGIN * max(found)


def _offset(poses: Array, origins: Array) -> Array:
    """Return (t - t_o, Log(R_o^T R)) of poses (..., 7) from origins (..., 7), (..., 6)."""
    return _CHART.coordinates(poses, origins) - _CHART.coordinates(origins, origins)


def _score(
    poses: Array,
    solved: Array,
    information: Array,
    regression: Array,
    half_width: Array,
    fusion: Fusion,
) -> float:
    """Return the interval score at 0.9 over n val frames, in units of their median error."""
    found = [
        fuse(*frame, fusion)
        for frame in zip(solved, information, regression, half_width, strict=True)
    ]
    error = np.abs([_offset(pose, each[0]) for pose, each in zip(poses, found, strict=True)])
    deviation = np.sqrt([np.diag(np.linalg.inv(each[1])) for each in found])
    q_hat = [conformal_quantile(column, 0.9) for column in (error / deviation).T]
    half = np.array(q_hat) * deviation
    unit = np.median(np.abs(_offset(poses, solved)), axis=0)
    return float((interval_score(2 * half, np.maximum(error - half, 0.0), 0.1) / unit).mean())
