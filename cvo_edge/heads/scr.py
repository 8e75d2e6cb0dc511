"""Scene coordinate regression (SCR): the network predicts points, a solver finds the pose.

The model gives for each cell of the image the world point X_i that the cell shows, and log s_i, the
scale of that point's reprojection error in pixels of the model's input (Shotton et al. 2013;
Brachmann and Rother 2021). ``cvo_edge.pose_solver`` finds the pose and, from the curvature of the
likelihood, a covariance C = L L^T of the six errors e = (t - t_hat, Log(R_hat^T R)). The
nonconformity scores are

    marginal  |e_d| / max(sqrt(C_dd), floor_d)      joint  |L'^-1 e|

where L' is L with its rows enlarged by the same floors. The marginal set is an interval about the
solved pose; the joint set is an ellipsoid. Frames that agree on a pose get narrow sets: C grows
with the disagreement of the cells (``dispersion``).

A frame also tells how far it can be trusted: in a place the network does not know, the cells are
vague, or disagree on the pose. ``Signs`` holds the limits, from frames of the known place. Over a
stream, the frames also show whether the camera is the stated one (``cvo_edge.camera_check``).
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from typing import Annotated, Any, ClassVar

import cv2
import numpy as np
from msgspec import Meta, Struct
from msgspec.structs import replace
from numpy.typing import NDArray

from cvo_edge.bundle.format import Calibration, Number, Positive, SixPositive, Threshold
from cvo_edge.camera_check import CameraCheck, LensLimits, fitted_limits
from cvo_edge.conformal import JointScale, LinearScale
from cvo_edge.errors import CalibrationFileError, UsageError
from cvo_edge.heads.base import Candidate, Head, Limit, Solved, Solver
from cvo_edge.heads.cqr import below_spread, infinite_where_null, refuse_negative
from cvo_edge.input.view import SeenCamera
from cvo_edge.pose_solver import PoseSolver, dispersion
from cvo_edge.record import Reason
from cvo_edge.sets import ConformalSet, Ellipsoids, scaled_distance, unbounded_set
from cvo_edge.vocabulary import Joint, Scope

Array = NDArray[np.float64]
Seven = tuple[Number, Number, Number, Number, Number, Number, Number]

# Longer last steps of the solver, in deviations, mean that the cells contradict each other.
_CONVERGED = 0.05
# Steps of the dispersion for another camera, within a percent of the limit.
_CONVERGED_STEPS = 20
# The signs look at this many cells of the smallest scale; a part of a known place suffices. A
# camera that shows the network fewer cells than usual has fewer of them in the same proportion.
BEST_CELLS = 100
# Fewer cells would leave too little to tell a known place from another.
_LEAST_SEEN = 0.25
# Share of the input that another camera's images fill at least to be checked as the learned one is.
_NEARLY_ALL = 0.9
# A cell contradicts the pose if its reprojection error exceeds this many scales.
_CONTRADICTS = 3.0
_HAIR = 1e-12
# Scales in pixels from e^-20 to e^20 are what a network may say.
_LARGEST_LOG = 20.0
# Deviations, m and rad, that damp the solver or bound a score from below.
_LEAST_DEVIATION, _LARGEST_DEVIATION = 1e-7, 1e6
_UNIT = 1e-3
# No error of a network is a smaller share of its deviation.
_LEAST_FACTOR = 1e-9
# Limits lie this far beyond the largest sign of the known frames, because a new recording of the
# same place has frames that are a little harder.
_MARGIN_ERROR, _MARGIN_CONTRADICTING = 1.3, 0.05
_LEAST_ERROR_PX = 0.1
# Where most of the best cells contradict the pose, a frame is lost, even if it was calibrated on:
# frames between the trained ones may show parts of the place that no trained frame shows.
LOST = 0.5


class Signs(Struct, frozen=True, forbid_unknown_fields=True):
    """What a frame says of itself: limits, or one frame's values.

    Over the cells of the smallest scale: ``error_px``, the median reprojection error in pixels of
    the model's input, which is large where the network does not know what it sees;
    ``contradicting``, the share whose error exceeds three scales, which is large where it knows
    the place, but the image is not what the camera would see.
    """

    error_px: Positive
    contradicting: Annotated[float, Meta(ge=0, le=1)]


class ScrParameters(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """``method_parameters`` of an SCR bundle.

    ``grid``: rows and columns of cells. ``starts``: poses tx ty tz qx qy qz qw from which the
    solver starts. ``damping``: deviation per DoF (m, rad) that damps its steps.
    ``deviation_floor``: smallest deviation per DoF (m, rad) in the scores. ``limits``: frames
    beyond them get no interval; null accepts every frame whose solver converges.
    ``camera_limits``: streams beyond them get no interval; null does not check the camera.
    """

    grid: tuple[Annotated[int, Meta(ge=1, le=1024)], Annotated[int, Meta(ge=1, le=1024)]]
    starts: Annotated[tuple[Seven, ...], Meta(min_length=1, max_length=64)]
    damping: SixPositive
    deviation_floor: SixPositive
    limits: Signs | None
    camera_limits: LensLimits | None


class ScrHead(Head):
    """Score, ellipsoid and intervals of scene coordinate regression."""

    method = "scr"
    parameters_type: ClassVar[type[Struct]] = ScrParameters
    score_names = ("normalised",)
    one_joint_score = True
    set_kind = "six at once, an ellipsoid"
    solves = True
    parameters: ScrParameters

    def __init__(self, parameters: ScrParameters, score: str) -> None:
        super().__init__(parameters, score)
        rows, columns = parameters.grid
        self.outputs = {"coordinates": (1, rows * columns, 3), "log_scale_px": (1, rows * columns)}
        self._floor = np.array(parameters.deviation_floor)

    def check(self, thresholds: Sequence[Threshold], joint: Joint) -> None:
        """As ``Head``: a single distance for all six DoF in the joint scope."""
        super().check(thresholds, joint)
        if joint != "max":
            raise CalibrationFileError(
                f"calibration.joint: expected max for {self.method}, which has one score for all "
                f"six DoF, found {joint}"
            )
        self._check_solver()
        for entry in thresholds:
            refuse_negative(entry, self.method)
            if entry.scope == "joint" and entry.q_hat != (entry.q_hat[0],) * 6:
                raise CalibrationFileError(
                    f"thresholds.q_hat: expected the same distance six times for {self.method} and "
                    f"scope joint, found {list(entry.q_hat)} at {entry.confidence}"
                )

    def largest_marginal(self, radius: float) -> float:
        """As ``Head``: no error is more deviations long than the distance of all six."""
        return radius

    def score_range(self) -> tuple[float, float]:
        """As ``Head``: no error is zero."""
        return _LEAST_FACTOR, math.inf

    def parameter_limits(self, calibration: Calibration) -> tuple[Limit, ...]:
        """As ``Head``; errors of more pixels than the input has do not tell places apart."""
        floors = below_spread("deviation_floor", self.parameters.deviation_floor, calibration)
        limits, inputs = self.parameters.limits, calibration.preprocess
        if limits is None:
            return floors
        return (
            *floors,
            Limit("limits.error_px", limits.error_px, max(inputs.height, inputs.width)),
            Limit("limits.contradicting", limits.contradicting, LOST),
        )

    def _check_solver(self) -> None:
        """Raise CalibrationFileError for parameters that no solver works with."""
        for name in ("damping", "deviation_floor"):
            values = getattr(self.parameters, name)
            if not _LEAST_DEVIATION <= min(values) <= max(values) <= _LARGEST_DEVIATION:
                raise CalibrationFileError(
                    f"method_parameters.{name}: expected {_LEAST_DEVIATION:g} to "
                    f"{_LARGEST_DEVIATION:g}, found {list(values)}"
                )
        lengths = np.linalg.norm(np.array(self.parameters.starts)[:, 3:], axis=1)
        if np.abs(lengths - 1.0).max() > _UNIT:
            raise CalibrationFileError(
                "method_parameters.starts: expected unit quaternions, found one of length "
                f"{lengths[np.abs(lengths - 1.0).argmax()]:g}"
            )

    def solver(self, seen: SeenCamera | None) -> Solver | None:
        """As ``Head``: adds ``pose`` (1, 7), ``signs`` (1, 2) and the rest.

        ``covariance`` (1, 6, 6) is that of the errors; ``solved_pose`` (1, 7) is the solver's,
        which fusion may change; ``lens_gradient`` (1, 3) and ``lens_information`` (1, 3, 3) are
        evidence for the camera check.
        """
        seen = _stated(seen)
        pose_solver, limits = self._pose_solver(seen), self.parameters.limits
        focal_px, cells = seen.camera.focal_px, math.prod(self.parameters.grid)
        count = max(1, round(min(BEST_CELLS, cells) * pose_solver.seen.mean()))
        whole = bool(pose_solver.seen.all())

        def solve(outputs: Mapping[str, NDArray[Any]]) -> Solved:
            log_scale = outputs["log_scale_px"][0]
            within = np.minimum(np.maximum(log_scale, -_LARGEST_LOG), _LARGEST_LOG)
            scale = np.exp(within.astype(np.float64)) / focal_px
            found = pose_solver.solve(outputs["coordinates"][0], scale)
            shown = log_scale if whole else np.where(pose_solver.seen, log_scale, np.inf)
            best = shown.argpartition(count - 1)[:count]
            squared = found.squared[best]
            error_px = focal_px * math.sqrt(_median(squared * scale[best] ** 2))
            contradicting = np.count_nonzero(squared > _CONTRADICTS**2) / count
            seen_squared = found.squared if whole else found.squared[pose_solver.seen]
            factor = dispersion(seen_squared, 1)
            # The network's scales have been calibrated for the learned camera only.
            if not seen.learned:
                factor = max(factor, dispersion(seen_squared, _CONVERGED_STEPS))
            pose, information, added = self.combined(
                outputs, found.pose, found.information / factor, seen
            )
            # Without full information, there is no covariance.
            certain, covariance = cv2.invert(information, flags=cv2.DECOMP_CHOLESKY)
            solved = {
                **outputs,
                **added,
                "pose": pose[np.newaxis],
                "covariance": covariance[np.newaxis],
                "signs": np.array([[error_px, contradicting]]),
                "solved_pose": found.pose[np.newaxis],
                "lens_gradient": found.lens.gradient[np.newaxis],
                "lens_information": found.lens.information[np.newaxis],
            }
            # Written so that NaN is strange.
            strange = (
                not found.last_step < _CONVERGED
                or not certain
                or (
                    limits is not None
                    and not (error_px <= limits.error_px and contradicting <= limits.contradicting)
                )
                or self.doubted(added)
            )
            return Solved(solved, Reason.IMAGE_UNFAMILIAR if strange else None)

        return solve

    def solver_error(self, seen: SeenCamera | None) -> float:
        """As ``Head``."""
        return self._pose_solver(_stated(seen)).error_on_exact_points()

    def camera_check(self, seen: SeenCamera | None) -> CameraCheck | None:
        """As ``Head``."""
        limits, signs = self.parameters.camera_limits, self.parameters.limits
        if limits is None or signs is None:
            return None
        seen = _stated(seen)
        solver, focal_px = self._pose_solver(seen), seen.camera.focal_px
        narrow = seen.filled < _NEARLY_ALL
        return CameraCheck(solver, focal_px, limits, signs.error_px, narrow=narrow)

    def _pose_solver(self, seen: SeenCamera) -> PoseSolver:
        rows, columns = self.parameters.grid
        if seen.camera.height * columns != seen.camera.width * rows:
            raise CalibrationFileError(
                f"method_parameters.grid: expected square cells for an input of "
                f"{seen.camera.width}x{seen.camera.height}, found {columns}x{rows}"
            )
        rays = seen.rays(self.parameters.grid)
        solver = PoseSolver(
            rays, np.array(self.parameters.starts), np.array(self.parameters.damping)
        )
        share = float(solver.seen.mean())
        if share < _LEAST_SEEN:
            raise UsageError(
                f"camera: expected images that show at least {_LEAST_SEEN:.0%} of the model's "
                f"cells, found {share:.0%}; give the intrinsics of the camera that takes the "
                "images, or train with a camera of this kind"
            )
        return solver

    def combined(
        self,
        outputs: Mapping[str, NDArray[Any]],
        solved: Array,
        information: Array,
        seen: SeenCamera,
    ) -> tuple[Array, Array, dict[str, Array]]:
        """Return pose (7,), information (6, 6) and further outputs; by default the solver's."""
        return solved, information, {}

    def doubted(self, added: Mapping[str, Array]) -> bool:
        """Return whether what ``combined`` added speaks against the frame; by default, no."""
        return False

    def tuned(
        self,
        val: Mapping[str, NDArray[Any]],
        poses: Array,
        known: Mapping[str, NDArray[Any]],
        sequence: NDArray[np.int64],
    ) -> ScrParameters:
        """As ``Head``: limits of the signs, a margin beyond the largest of the known frames.

        Frames that are lost have no part in the limits.
        """
        signs = known["signs"]
        located = signs[:, 1] <= LOST
        error_px, contradicting = signs[located].max(axis=0, initial=0.0).tolist()
        limits = Signs(
            max(error_px, _LEAST_ERROR_PX) * _MARGIN_ERROR,
            min(LOST, contradicting + _MARGIN_CONTRADICTING),
        )
        camera_limits = fitted_limits(known, sequence)
        return replace(self.parameters, limits=limits, camera_limits=camera_limits)

    def joint_scale(self, scores: Array) -> JointScale:
        """As ``Head``; one distance needs no scaling."""
        return LinearScale(np.ones(scores.shape[1:]))

    def scored_outputs(self) -> Collection[str]:
        """As ``Head``: the covariance of the errors, without the cells."""
        return ("covariance",)

    def plain_scores(
        self,
        outputs: Mapping[str, NDArray[Any]],
        point: Array,
        truth: Array,
        scope: Scope = "marginal",
    ) -> Array:
        """Outputs stacked over n frames, point and truth (n, 6) -> scores (n, 1, 6)."""
        deviation, error = self._deviations(outputs), truth - point
        if scope == "joint":
            scale = self._scales(outputs)
            distance = scaled_distance(np.zeros((len(error), 1, 6)), scale, error)
            return np.tile(distance[:, np.newaxis, np.newaxis], (1, 1, 6))
        return np.asarray(np.abs(error) / deviation)[:, np.newaxis]

    def plain_set(
        self, outputs: Mapping[str, NDArray[Any]], point: Array, threshold: Threshold
    ) -> ConformalSet:
        """Outputs and point (6,) of one frame -> six intervals, or an ellipsoid and its hull."""
        q_hat = infinite_where_null(threshold.q_hat)
        deviation = self._deviations(outputs)[0]
        if threshold.scope == "marginal":
            reach = q_hat * deviation
            return ConformalSet(point - reach, point + reach)
        radius, scale = float(q_hat[0]), self._scales(outputs)[0]
        if radius == np.inf or not np.isfinite(scale).all():
            return unbounded_set()
        # Slightly enlarged, so that rounding leaves no point of the ellipsoid outside its hull.
        reach = radius * deviation * (1.0 + _HAIR) + _HAIR * np.abs(point)
        ellipsoid = Ellipsoids(point[np.newaxis], scale, radius)
        return ConformalSet(point - reach, point + reach, ellipsoids=ellipsoid)

    def candidates(self) -> tuple[Candidate, ...]:
        """As ``Head``; other data need other limits."""
        return (Candidate(self.score, replace(self.parameters, limits=None, camera_limits=None)),)

    def description(self) -> str:
        """As ``Head``."""
        rows, columns = self.parameters.grid
        text = f"{columns}x{rows} cells"
        limits, camera = self.parameters.limits, self.parameters.camera_limits
        if limits is not None:
            text += (
                f", refused beyond {limits.error_px:.2g} px or {limits.contradicting:.0%} of cells "
                "that contradict"
            )
        if camera is not None:
            text += f", focal length checked to {camera.log_focal:.1%}"
        return text

    def joint_description(self, joint: Joint) -> str:
        """As ``Head``."""
        return "Mahalanobis distance under the solver's covariance"

    def _deviations(self, outputs: Mapping[str, NDArray[Any]]) -> Array:
        """Return the deviations of the errors of n frames, at least the floor, (n, 6)."""
        variance = outputs["covariance"].diagonal(axis1=1, axis2=2)
        return np.asarray(np.maximum(np.sqrt(variance), self._floor))

    def _scales(self, outputs: Mapping[str, NDArray[Any]]) -> Array:
        """Return the Cholesky factors of n covariances, (n, 6, 6), NaN for an indefinite one.

        The floor enlarges their rows.
        """
        scales = np.array([_lower_triangular(each) for each in outputs["covariance"]])
        length = np.sqrt(np.square(scales).sum(axis=-1, keepdims=True))
        return np.asarray(scales * np.maximum(1.0, self._floor[:, np.newaxis] / length))


def _stated(seen: SeenCamera | None) -> SeenCamera:
    if seen is None:
        raise CalibrationFileError(
            "camera: expected intrinsics, which the solver needs, found null"
        )
    return seen


def _median(values: Array) -> float:
    """Return the median of values (n,), which it sorts; numpy's takes ten times as long."""
    values.sort()
    return 0.5 * float(values[(len(values) - 1) // 2] + values[len(values) // 2])


def _lower_triangular(covariance: Array) -> Array:
    """Return the Cholesky factor (6, 6); NaN if rounding made the covariance indefinite."""
    try:
        return np.asarray(np.linalg.cholesky(covariance))
    except np.linalg.LinAlgError:
        return np.full((6, 6), np.nan)
