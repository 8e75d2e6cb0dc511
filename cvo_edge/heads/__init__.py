"""One conformal method a file: its nonconformity score and the inverse, from threshold to set.

``HEADS`` is the registry: a new method is one file here, one of the same name on the training
side, and one line in each registry.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Protocol

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from cvo_edge.bundle.format import Calibration, Threshold
from cvo_edge.conformal import JointScale
from cvo_edge.heads.cjp import CjpHead
from cvo_edge.heads.cqr import CqrHead
from cvo_edge.heads.csp import CspHead
from cvo_edge.heads.mcqr import McqrHead
from cvo_edge.sets import ConformalSet, Scope

Array = NDArray[np.float64]


class Head(Protocol):
    """What every method provides to the odometer and to calibration.

    Scores have the shape (n, sides, 6): one side where a single threshold bounds a degree of
    freedom's set, two where the lower and the upper bound have one each.
    """

    parameters_type: ClassVar[type[Struct]]
    # Whether the joint scope has a score of all six together, not six that are compared.
    one_joint_score: ClassVar[bool]
    # Name and shape of every model output the method reads, all float32.
    outputs: Mapping[str, tuple[int, ...]]

    def __init__(self, calibration: Calibration) -> None:
        """Read the method's parameters; raises CalibrationFileError where they are not its own."""

    def extra_inputs(self, seq: int) -> Mapping[str, NDArray[np.float32]]:
        """Model inputs besides the image for frame number ``seq``."""

    def side_confidences(self, confidence: float) -> tuple[float | None, ...]:
        """The confidence of each side's threshold in the marginal scope; None: never bounded."""

    def joint_scale(self, scores: Array) -> JointScale:
        """Scores (n, sides, 6) of val -> how columns are compared for the joint scope."""

    def scores(
        self,
        outputs: Mapping[str, NDArray[Any]],
        point: Array,
        truth: Array,
        scope: Scope = "marginal",
    ) -> Array:
        """Outputs stacked over n frames; point and truth (n, 6) -> scores (n, sides, 6).

        Those of the joint scope are other ones where ``one_joint_score``.
        """

    def conformal_set(
        self, outputs: Mapping[str, NDArray[Any]], point: Array, threshold: Threshold
    ) -> ConformalSet:
        """The set {y : score(y) <= q_hat} of one frame; point (6,)."""


HEADS: dict[str, type[Head]] = {
    "cjp": CjpHead,
    "cqr": CqrHead,
    "csp": CspHead,
    "mcqr": McqrHead,
}
