"""Frames of a data set as the runtime sees them: a network's outputs, and scores of the truth."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cvo_edge.bundle.format import FAMILIARITY, Threshold
from cvo_edge.engine.observation import Observation, Observer
from cvo_edge.errors import SourceError
from cvo_edge.heads import Head
from cvo_edge.input.image_checks import has_colour
from cvo_edge.monitor.watch import tells_of_the_place
from cvo_edge.odometer import Odometer
from cvo_edge.pose import about
from cvo_edge.sets import ConformalSet
from cvo_edge.vocabulary import SCOPES
from cvo_export.bundles.refused import Refused
from cvo_export.datasets import PoseDataset

Array = NDArray[np.float64]


class Scored(NamedTuple):
    """Scores of n frames per scope, (n, sides, 6), and the frames' sequence numbers (n,)."""

    marginal: Array
    joint: Array
    sequence: NDArray[np.int64]


class Judged(NamedTuple):
    """The m frames that the alarm judges: those that passed, and those only a solver doubts.

    Statistics (m, 5), sequence numbers (m,), and which images have colour (m,).
    """

    values: Array
    sequence: NDArray[np.int64]
    coloured: NDArray[np.bool_]


@dataclass(frozen=True)
class Observed:
    """The runtime's results for the n frames that passed the frame checks, stacked.

    ``outputs`` (n, ...) are the network's outputs by name; ``point`` and ``truth`` (n, 6) are in
    the bundle's chart; ``pose`` and ``true_pose`` are (n, 7); all positions are relative to the
    bundle's origin. ``sequence`` (n,) holds sequence numbers; ``coloured`` (n,) tells which images
    have colour; ``size`` is width and height of the first image; ``refused`` counts the frames that
    the checks excluded. ``judged`` is None if the graph has no statistics.
    """

    indices: NDArray[np.int64]
    outputs: dict[str, NDArray[np.float32]]
    point: Array
    truth: Array
    pose: Array
    true_pose: Array
    sequence: NDArray[np.int64]
    coloured: NDArray[np.bool_]
    size: tuple[int, int]
    refused: Refused
    judged: Judged | None

    def in_colour(self) -> Observed:
        """Return the frames whose images have colour; counts of excluded frames stay."""
        judged = self.judged
        if judged is not None:
            rows = judged.coloured
            judged = Judged(judged.values[rows], judged.sequence[rows], judged.coloured[rows])
        return dataclasses.replace(self.where(self.coloured), judged=judged)

    def where(self, rows: NDArray[np.bool_]) -> Observed:
        """Return the frames that a mask (n,) chooses; counts, and what is judged, stay."""
        chosen = {
            name: getattr(self, name)[rows]
            for name in ("indices", "point", "truth", "pose", "true_pose", "sequence", "coloured")
        }
        outputs = {name: values[rows] for name, values in self.outputs.items()}
        return dataclasses.replace(self, outputs=outputs, **chosen)

    def scored(self, head: Head) -> Scored:
        """Return the scores of the true poses."""
        marginal, joint = (
            head.scores(self.outputs, self.point, self.truth, scope) for scope in SCOPES
        )
        return Scored(marginal, joint, self.sequence)

    def sets(self, head: Head, entry: Threshold) -> list[ConformalSet]:
        """Return the set of every frame at one threshold entry."""
        return [
            head.conformal_set(
                {name: values[row : row + 1] for name, values in self.outputs.items()},
                point,
                entry,
            )
            for row, point in enumerate(self.point)
        ]


def observe(
    observer: Observer | Odometer, dataset: PoseDataset, indices: NDArray[np.int64]
) -> Observed:
    """Run frames of a data set through a network, in order.

    Raises SourceError if no frame passes the checks.
    """
    kept: list[int] = []
    seen: list[Observation] = []
    judged: list[tuple[NDArray[np.float32], int, bool]] = []
    refused = Refused()
    for index in indices.tolist():
        image, unread = None, ""
        try:
            image = dataset.read_image(index)
        except SourceError as error:
            unread = str(error)  # flagged as invalid, as on the device
        observation = observer.observe(image, seq=index)
        if tells_of_the_place(observation) and observation.look is not None:
            number = int(dataset.sequence[index])
            judged.append((_statistics(observation), number, has_colour(observation.look)))
        if observation.fault is None and observation.doubt is None:
            kept.append(index)
            seen.append(observation)
        else:
            true_pose = about(dataset.poses[index], observer.origin_m)
            refused.add(observation, dataset.frame_names[index], true_pose, unread)
    if not seen:
        raise SourceError(
            f"{dataset.name}: expected frames that pass the frame checks, found none of "
            f"{len(indices)}: {refused}"
        )
    pose = np.array([observation.pose for observation in seen])
    looks = [observation.look for observation in seen if observation.look is not None]
    true_pose = about(dataset.poses[kept], observer.origin_m)
    return Observed(
        indices=np.array(kept),
        outputs={
            name: np.concatenate([observation.outputs[name] for observation in seen])
            for name in seen[0].outputs
        },
        point=np.array([observation.point for observation in seen]),
        truth=observer.chart.coordinates(true_pose, pose),
        pose=pose,
        true_pose=true_pose,
        sequence=dataset.sequence[kept],
        coloured=np.array([has_colour(look) for look in looks]),
        size=(looks[0].size[1], looks[0].size[0]),
        refused=refused,
        judged=_judged(judged),
    )


def _statistics(observation: Observation) -> NDArray[np.float32]:
    """Return the statistics (5,) of a frame, or none, (0,)."""
    outputs = observation.outputs
    found = [outputs[name][0] for name in FAMILIARITY if name in outputs]
    return np.concatenate([np.zeros(0, np.float32), *found])


def _judged(rows: list[tuple[NDArray[np.float32], int, bool]]) -> Judged | None:
    values, sequence, coloured = (np.array(part) for part in zip(*rows, strict=True))
    return Judged(values.astype(np.float64), sequence, coloured) if values.shape[1] else None


def in_order(*observed: Observed) -> tuple[dict[str, NDArray[Any]], NDArray[np.int64]]:
    """Return outputs and sequence numbers of several roles, stacked in the data set's order."""
    order = np.argsort(np.concatenate([each.indices for each in observed]))
    outputs = {
        name: np.concatenate([each.outputs[name] for each in observed])[order]
        for name in observed[0].outputs
    }
    return outputs, np.concatenate([each.sequence for each in observed])[order]
