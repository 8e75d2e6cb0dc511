"""Conformalized set prediction (CSP): degrees of freedom as classes, sets as unions of classes.

The workspace of a degree of freedom is divided into K classes, which are narrow where training
poses are dense; the model gives a probability p_k for each class. The set holds every class whose
nonconformity score is at most the conformal quantile. Adjacent classes merge into bands, and a set
may have several bands. ``calibration.score`` names one of three scores; r_k is the rank of class k,
counted from 1 in descending order of probability:

- ``lac`` (Sadinle, Lei and Wasserman 2019; the paper): 1 - p_k.
- ``aps`` (Romano, Sesia and Candes 2020, without randomisation): the total probability of the
  classes up to rank r_k.
- ``raps`` (Angelopoulos, Bates, Malik and Jordan 2021): ``aps`` + penalty * max(0, r_k - free).

The most probable class is always in the set. A truth outside the workspace has an infinite score in
calibration and in evaluation, so coverage counts it as a miss, and sets end at the workspace.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Annotated, Any, Literal, get_args

import numpy as np
from msgspec import Meta, Struct
from msgspec.structs import replace
from numpy.typing import NDArray

from cvo_edge.bundle.format import Number, Threshold
from cvo_edge.conformal import JointScale, RankScale
from cvo_edge.errors import CalibrationFileError
from cvo_edge.heads.base import Candidate, Head
from cvo_edge.heads.cqr import infinite_where_null
from cvo_edge.sets import ConformalSet
from cvo_edge.vocabulary import Scope

Array = NDArray[np.float64]
Score = Literal["lac", "aps", "raps"]
_SIX = np.arange(6)
# Defaults of the raps score for a bundle without a penalty.
_PENALTY, _FREE_RANKS = 0.01, 5
# The likeliest of at most 512 classes has at least this probability; sums of them may exceed 1.
_LEAST_TOTAL, _SUM = 1e-3, 1e-3
Edges = Annotated[tuple[Number, ...], Meta(min_length=3, max_length=513)]


class CspParameters(Struct, frozen=True, forbid_unknown_fields=True):
    """``method_parameters`` of a CSP bundle.

    ``edges``: the ascending class edges (m, rad) of each DoF, one more than its classes; a DoF with
    fewer classes than another leaves its last probabilities unused. ``penalty`` and ``free_ranks``
    belong to the ``raps`` score.
    """

    edges: tuple[Edges, Edges, Edges, Edges, Edges, Edges]
    penalty: Annotated[float, Meta(ge=0, le=10)]
    free_ranks: Annotated[int, Meta(ge=0, le=512)]


class CspHead(Head):
    """Score and set of conformalized set prediction."""

    method = "csp"
    parameters_type = CspParameters
    score_names = get_args(Score)
    continuous = False
    infinite_score = "too many calibration truths lie outside the workspace of the classes"
    parameters: CspParameters

    def __init__(self, parameters: CspParameters, score: Score) -> None:
        super().__init__(parameters, score)
        self._score: Score = score
        edges = parameters.edges
        for dof, row in enumerate(edges):
            if any(not low < high for low, high in pairwise(row)):
                raise CalibrationFileError(
                    f"method_parameters.edges: expected ascending edges, found others at [{dof}]"
                )
        self._classes = np.array([len(row) - 1 for row in edges])
        most = int(self._classes.max())
        self.outputs = {
            "pose": (1, 7),
            "probabilities": (1, 6, most),
        }
        self._edges = np.array([(*row, *(row[-1],) * (most + 1 - len(row))) for row in edges])
        self._unused = np.arange(most) >= self._classes[:, None]

    def joint_scale(self, scores: Array) -> JointScale:
        """Val scores (n, 1, 6) -> the scale that makes DoFs comparable in the joint scope."""
        return RankScale.fitted(scores, self._top())

    def score_range(self) -> tuple[float, float]:
        """As ``Head``."""
        return 0.0 if self._score == "lac" else _LEAST_TOTAL, self._top() + _SUM

    def shifts(self, scope: Scope) -> bool:
        """As ``Head``; scores of classes have an end, where a set holds every class."""
        return True

    def _top(self) -> float:
        """Return the largest finite score."""
        if self._score != "raps":
            return 1.0
        ranks = int(self._classes.max()) - self.parameters.free_ranks
        return 1.0 + self.parameters.penalty * max(0, ranks)

    def plain_scores(
        self,
        outputs: Mapping[str, NDArray[Any]],
        point: Array,
        truth: Array,
        scope: Scope = "marginal",
    ) -> Array:
        """Output ``probabilities`` (n, 6, K), point and truth (n, 6) -> scores (n, 1, 6)."""
        classes = self._class_scores(outputs["probabilities"])
        of_truth = np.full(truth.shape, np.inf)
        for dof, edges in enumerate(self.parameters.edges):
            y = truth[:, dof]
            inside = (edges[0] <= y) & (y <= edges[-1])
            index = np.searchsorted(edges[1:-1], y, side="right")
            found = classes[np.arange(len(y)), dof, index]
            of_truth[:, dof] = np.where(inside, found, np.inf)
        return of_truth[:, np.newaxis]

    def plain_set(
        self, outputs: Mapping[str, NDArray[Any]], point: Array, threshold: Threshold
    ) -> ConformalSet:
        """Outputs of one frame -> its bands and their hull; ``point`` is not used."""
        probabilities = outputs["probabilities"]
        q_hat = infinite_where_null(threshold.q_hat)
        inside = self._class_scores(probabilities)[0] <= q_hat[:, np.newaxis]
        likeliest = probabilities[0]
        if self._unused.any():
            inside &= ~self._unused
            likeliest = np.where(self._unused, -1.0, likeliest)
        inside[_SIX, likeliest.argmax(axis=1)] = True
        # Positions where membership changes, row by row: starts and ends alternate.
        framed = np.zeros((6, inside.shape[1] + 2), dtype=np.bool_)
        framed[:, 1:-1] = inside
        dof, where = np.nonzero(framed[:, 1:] != framed[:, :-1])
        ends = self._edges[dof, where].tolist()
        bands: list[list[tuple[float, float]]] = [[], [], [], [], [], []]
        for row, low, high in zip(dof[::2].tolist(), ends[::2], ends[1::2], strict=True):
            bands[row].append((low, high))
        for row, q in enumerate(threshold.q_hat):
            if q is None:
                bands[row] = [(-np.inf, np.inf)]
        return ConformalSet(
            np.array([row[0][0] for row in bands]),
            np.array([row[-1][1] for row in bands]),
            bands=(*map(tuple, bands),),
        )

    def candidates(self) -> tuple[Candidate, ...]:
        """As ``Head``; the raps score gets a default penalty if the bundle has none."""
        plain = penalised = self.parameters
        if plain.penalty == 0.0:
            penalised = replace(plain, penalty=_PENALTY, free_ranks=_FREE_RANKS)
        family = {"aps": plain, "lac": plain, "raps": penalised}
        own = {self.score: plain}
        return tuple(Candidate(name, of) for name, of in (own | family | own).items())

    def figures(self, sets: Sequence[ConformalSet]) -> dict[str, Any]:
        """As ``Head``: ``set_size`` (6,), the mean number of classes per set of each DoF."""
        return {"set_size": np.mean([self.classes_in(each) for each in sets], axis=0).tolist()}

    @classmethod
    def figures_text(cls, figures: Mapping[str, Any]) -> str:
        """As ``Head``."""
        return f"classes per set {np.mean(figures['set_size']):.1f}"

    def description(self) -> str:
        """As ``Head``: the number of classes per degree of freedom."""
        counts = [len(row) - 1 for row in self.parameters.edges]
        return f"{min(counts)} to {max(counts)} classes per degree of freedom"

    def classes_in(self, conformal_set: ConformalSet) -> NDArray[np.int64]:
        """Return the number of classes per DoF in a set of this head, (6,); all if unbounded."""
        counts = []
        for edges, row in zip(self.parameters.edges, conformal_set.bands or (), strict=True):
            ends = np.searchsorted(edges, np.clip(np.array(row), edges[0], edges[-1]))
            counts.append(int((ends[:, 1] - ends[:, 0]).sum()))
        return np.array(counts)

    def _class_scores(self, probabilities: NDArray[Any]) -> Array:
        parameters = self.parameters
        return class_scores(probabilities, self._score, parameters.penalty, parameters.free_ranks)


def class_scores(
    probabilities: NDArray[Any], score: Score, penalty: float = 0.0, free_ranks: int = 0
) -> Array:
    """Probabilities (n, 6, K) -> the score of each class if it were the truth, (n, 6, K).

    Calibration and prediction share this function, so a class is in the set exactly if its score is
    at most the threshold.
    """
    p = probabilities.astype(np.float64)
    if score == "lac":
        return np.asarray(1.0 - p)
    # numpy indexes one flat array several times faster than along an axis.
    rows = np.arange(0, p.size, p.shape[-1]).reshape(*p.shape[:-1], 1)
    order = np.argsort(-p, axis=-1, kind="stable") + rows
    ranked = np.cumsum(p.ravel()[order], axis=-1)
    if score == "raps":
        ranked += penalty * np.maximum(np.arange(1, p.shape[-1] + 1) - free_ranks, 0)
    scores = np.empty(p.size)
    scores[order] = ranked
    return scores.reshape(p.shape)
