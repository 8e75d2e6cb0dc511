"""The interface of a conformal method for the odometer, calibration and reports."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping, Sequence
from copy import copy
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from cvo_edge.bundle.format import NOVELTY_OUTPUT, Calibration, DifficultySpec, Threshold
from cvo_edge.camera_check import CameraCheck
from cvo_edge.conformal import JointScale, LinearScale
from cvo_edge.errors import CalibrationFileError
from cvo_edge.heads.difficulty import Difficulty
from cvo_edge.input.view import SeenCamera
from cvo_edge.record import Reason
from cvo_edge.sets import ConformalSet
from cvo_edge.vocabulary import Joint, Scope

Array = NDArray[np.float64]


class Candidate(NamedTuple):
    """A nonconformity score and the ``method_parameters`` that go with it."""

    score: str
    parameters: Struct


class Limit(NamedTuple):
    """A number of ``method_parameters``, and the most that it can be."""

    key: str
    value: float
    most: float


class Solved(NamedTuple):
    """A frame's outputs with what a solver adds, and why no interval may be claimed, or None."""

    outputs: Mapping[str, NDArray[Any]]
    doubt: Reason | None


Solver = Callable[[Mapping[str, NDArray[Any]]], Solved]


class Head(ABC):
    """One method: its nonconformity score, the inverse (threshold to set), and its description.

    Scores have the shape (n, sides, 6), with one side if a single threshold bounds the set of a
    degree of freedom, and two if the lower and upper bound have separate thresholds.

    Parameters
    ----------
    parameters
        An instance of ``parameters_type``.
    score
        One of ``score_names``.

    Raises
    ------
    CalibrationFileError
        The method does not have this score, or the parameters contradict it.

    Attributes
    ----------
    outputs
        Name and shape of every model output that the method reads; all are float32.
    difficulty
        What scales the sets from frame to frame, or None; see ``scaled``.
    """

    method: ClassVar[str]
    parameters_type: ClassVar[type[Struct]]
    score_names: ClassVar[tuple[str, ...]]
    # Whether the joint scope has a single score for all six degrees of freedom.
    one_joint_score: ClassVar[bool] = False
    # Whether the pose comes from a solver that knows the camera, instead of from the network.
    solves: ClassVar[bool] = False
    # For reports: the kind of set that the joint scope has.
    set_kind: ClassVar[str] = "each degree of freedom"
    # Whether the scores of different frames are finite and differ; a class score may do neither.
    continuous: ClassVar[bool] = True
    # For reports: why a threshold may be unbounded despite enough calibration frames.
    infinite_score: ClassVar[str] = "too many calibration truths have an infinite score"

    outputs: Mapping[str, tuple[int, ...]]
    difficulty: Difficulty | None = None

    def __init__(self, parameters: Any, score: str) -> None:  # noqa: ANN401 - the method's struct
        if score not in self.score_names:
            raise CalibrationFileError(
                f"calibration.score: expected one of {', '.join(self.score_names)} for "
                f"{self.method}, found {score!r}"
            )
        self.parameters = parameters
        self.score = score

    def check(self, thresholds: Sequence[Threshold], joint: Joint) -> None:
        """Raise CalibrationFileError for thresholds that the method cannot have."""
        if any(entry.q_hat_upper is not None for entry in thresholds):
            raise CalibrationFileError(
                f"thresholds.q_hat_upper: expected null for {self.method}, found numbers"
            )

    def extra_inputs(self, seq: int) -> Mapping[str, NDArray[np.float32]]:
        """Return the model inputs besides the image for frame ``seq``; none by default."""
        return {}

    def solver(self, seen: SeenCamera | None) -> Solver | None:
        """Return the function that computes ``pose`` (1, 7) from one frame's model outputs.

        The default is None, for networks that give the pose themselves. ``seen`` is None if no
        intrinsics are known; raises CalibrationFileError if the method needs them, and UsageError
        if that camera shows the network too little.
        """
        return None

    def solver_error(self, seen: SeenCamera | None) -> float:
        """Return how wrong the solver is on this machine, for a known pose; 0 without a solver.

        Arguments as for ``solver``; the unit is of the size of the place, or rad.
        """
        return 0.0

    def camera_check(self, seen: SeenCamera | None) -> CameraCheck | None:
        """Return the check of a stream's camera; None by default. Arguments as for ``solver``."""
        return None

    def side_confidences(self, confidence: float) -> tuple[float | None, ...]:
        """Return the marginal confidence of each side's threshold; None for an unbounded side."""
        return (confidence,)

    def levels(self, entry: Threshold, joint: Joint) -> tuple[float | None, ...]:
        """Return the level of each side's quantile for a threshold; None for an unbounded side."""
        sides = self.side_confidences(entry.confidence)
        if entry.scope == "marginal":
            return sides
        if joint == "bonferroni":
            return self.side_confidences(1.0 - (1.0 - entry.confidence) / 6)
        return tuple(None if level is None else entry.confidence for level in sides)

    def largest_marginal(self, radius: float) -> float:
        """Return the largest marginal threshold beside a joint one of the same level.

        Only for methods with ``one_joint_score``; infinite if their scores have no such order.
        """
        return math.inf

    def score_range(self) -> tuple[float, float]:
        """Return the least and the largest finite threshold that scores can have."""
        return -math.inf, math.inf

    def parameter_limits(self, calibration: Calibration) -> tuple[Limit, ...]:
        """Return the largest values that parameters of an honest bundle have; none by default.

        Honest floors, m and rad, are a small share of the spread of the poses.
        """
        return ()

    def joint_scale(self, scores: Array) -> JointScale:
        """Val scores (n, sides, 6) -> the scale that makes them comparable in the joint scope."""
        return LinearScale.fitted(scores)

    def shifts(self, scope: Scope) -> bool:
        """Whether adaptation adds to the thresholds; by default it multiplies them.

        Multiples need scores that are never negative and have no upper end.
        """
        return False

    def scored_outputs(self) -> Collection[str]:
        """Return the names of the outputs that ``scores`` reads; by default all."""
        return self.outputs if self.difficulty is None else (*self.outputs, NOVELTY_OUTPUT)

    def scaled(self, difficulty: DifficultySpec | None) -> Self:
        """Return the head whose sets are scaled by the difficulty of each frame; None for none."""
        head = copy(self)
        head.difficulty = None if difficulty is None else Difficulty(difficulty)
        return head

    def scores(
        self,
        outputs: Mapping[str, NDArray[Any]],
        point: Array,
        truth: Array,
        scope: Scope = "marginal",
    ) -> Array:
        """Outputs stacked over n frames, point and truth (n, 6) -> scores (n, sides, 6).

        With ``one_joint_score``, the scores depend on the scope. With a difficulty u, they are the
        plain scores of point + (truth - point) / u.
        """
        if self.difficulty is not None:
            truth = point + (truth - point) / self.difficulty.factors(outputs)[:, np.newaxis]
        return self.plain_scores(outputs, point, truth, scope)

    def conformal_set(
        self, outputs: Mapping[str, NDArray[Any]], point: Array, threshold: Threshold
    ) -> ConformalSet:
        """Return the set {y : score(y) <= q_hat} of one frame; point (6,).

        With a difficulty u, this is the plain set, stretched by u about the point.
        """
        found = self.plain_set(outputs, point, threshold)
        if self.difficulty is None:
            return found
        return found.stretched(point, self.difficulty.factor(outputs[NOVELTY_OUTPUT][0].tolist()))

    @abstractmethod
    def plain_scores(
        self,
        outputs: Mapping[str, NDArray[Any]],
        point: Array,
        truth: Array,
        scope: Scope = "marginal",
    ) -> Array:
        """As ``scores``, whatever the difficulty of the frames."""

    @abstractmethod
    def plain_set(
        self, outputs: Mapping[str, NDArray[Any]], point: Array, threshold: Threshold
    ) -> ConformalSet:
        """As ``conformal_set``, whatever the difficulty of the frame."""

    def tuned(
        self,
        val: Mapping[str, NDArray[Any]],
        poses: Array,
        known: Mapping[str, NDArray[Any]],
        sequence: NDArray[np.int64],
    ) -> Struct:
        """Return the parameters with what frames of the known place decide; by default unchanged.

        Parameters
        ----------
        val, poses
            Outputs of n val frames, stacked, and their true poses (n, 7): for choices.
        known, sequence
            Outputs of all val and cal frames in the order of the data set, and the numbers of the
            sequences they belong to: for limits. Frames beyond them are left out of the
            calibration, as they get no interval at run time.
        """
        parameters: Struct = self.parameters
        return parameters

    def candidates(self) -> tuple[Candidate, ...]:
        """Return the scores that recalibration can choose from, the current one first."""
        return (Candidate(self.score, self.parameters),)

    def own_sets(self, outputs: Mapping[str, NDArray[Any]], point: Array) -> list[ConformalSet]:
        """Return the network's own 90 % bounds of n frames, before any threshold is applied.

        The default is an empty list, for networks that give no bounds.
        """
        return []

    def figures(self, sets: Sequence[ConformalSet]) -> dict[str, Any]:
        """Return method-specific figures of n sets for ``evaluate``; none by default."""
        return {}

    @classmethod
    def figures_text(cls, figures: Mapping[str, Any]) -> str:  # noqa: ARG003 - a protocol
        """Return the result of ``figures`` as readable text; empty by default."""
        return ""

    def description(self) -> str:
        """Return a readable description of the parameters; empty by default."""
        return ""

    def joint_description(self, joint: Joint) -> str:
        """Return a readable description of how the joint scope combines the scores."""
        return joint
