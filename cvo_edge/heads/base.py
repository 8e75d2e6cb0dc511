"""What every conformal method provides, to the odometer, to calibration and to reports."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from cvo_edge.bundle.format import Joint, Threshold
from cvo_edge.conformal import JointScale, LinearScale
from cvo_edge.errors import CalibrationFileError
from cvo_edge.sets import ConformalSet, Scope

Array = NDArray[np.float64]


class Candidate(NamedTuple):
    """A nonconformity score and the ``method_parameters`` that go with it."""

    score: str
    parameters: Struct


class Head(ABC):
    """One method: its nonconformity score, the inverse (threshold to set), and what to say of it.

    Scores have the shape (n, sides, 6): one side where a single threshold bounds the set of a
    degree of freedom, two where the lower and the upper bound have one each.

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
        Name and shape of every model output that the method reads, all float32.
    """

    method: ClassVar[str]
    parameters_type: ClassVar[type[Struct]]
    score_names: ClassVar[tuple[str, ...]]
    # Whether the joint scope has one score for all six degrees of freedom, not six to compare.
    one_joint_score: ClassVar[bool] = False
    # For reports: what the set of the method holds.
    set_kind: ClassVar[str] = "each degree of freedom"
    # For reports: why a threshold can be unbounded although there are enough calibration frames.
    infinite_score: ClassVar[str] = "too many calibration truths have an infinite score"

    outputs: Mapping[str, tuple[int, ...]]

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
        """Model inputs besides the image for frame number ``seq``; by default none."""
        return {}

    def side_confidences(self, confidence: float) -> tuple[float | None, ...]:
        """Marginal confidence of each side's threshold; None where a side is never bounded."""
        return (confidence,)

    def joint_scale(self, scores: Array) -> JointScale:
        """Scores (n, sides, 6) of val -> how columns are compared for the joint scope."""
        return LinearScale.fitted(scores)

    @abstractmethod
    def scores(
        self,
        outputs: Mapping[str, NDArray[Any]],
        point: Array,
        truth: Array,
        scope: Scope = "marginal",
    ) -> Array:
        """Outputs stacked over n frames, point and truth (n, 6) -> scores (n, sides, 6).

        With ``one_joint_score`` the joint scope has scores of its own.
        """

    @abstractmethod
    def conformal_set(
        self, outputs: Mapping[str, NDArray[Any]], point: Array, threshold: Threshold
    ) -> ConformalSet:
        """Return the set {y : score(y) <= q_hat} of one frame; point (6,)."""

    def candidates(self) -> tuple[Candidate, ...]:
        """Return the scores that a calibration on other data chooses among, its own first."""
        return (Candidate(self.score, self.parameters),)

    def own_sets(self, outputs: Mapping[str, NDArray[Any]], point: Array) -> list[ConformalSet]:
        """Return the network's own 90 % bounds of n frames, before any threshold.

        By default nothing: the network gives no bounds of its own.
        """
        return []

    def figures(self, sets: Sequence[ConformalSet]) -> dict[str, Any]:
        """Return figures of n sets that only this method has, for ``evaluate``; by default none."""
        return {}

    @classmethod
    def figures_text(cls, figures: Mapping[str, Any]) -> str:  # noqa: ARG003 - a protocol
        """Return what ``figures`` found, as text for a person; empty where there is nothing."""
        return ""

    def description(self) -> str:
        """Return what the parameters say, as text for a person; by default nothing."""
        return ""

    def joint_description(self, joint: Joint) -> str:
        """Return how the joint scope is made, as text for a person."""
        return joint
