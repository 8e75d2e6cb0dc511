"""Fit the difficulty of frames, see ``cvo_edge.heads.difficulty``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cvo_edge.bundle.format import DifficultySpec, SplitSpec, Threshold
from cvo_edge.heads import Head
from cvo_edge.heads.difficulty import features
from cvo_export.bundles.draft import four
from cvo_export.bundles.observed import Observed
from cvo_export.data.noise import KINDS, drawn
from cvo_export.datasets import PoseDataset

Array = NDArray[np.float64]

# Copies of val frames with each kind of noise.
_COPIES = 100
# Of log u. Easy frames keep half of their width; the upper end is a 33 fold one.
_LOWEST, _HIGHEST = -0.7, 3.5
# Errors below this share of a set count as if they were it: their logarithms tell little.
_LEAST_SHARE = 0.02
_RIDGE, _LEAST = 1.0, 1e-9
# Steeper than the fit to single errors, which regresses to the mean.
_STEEPER = 1.2


def degraded(
    see: Callable[[PoseDataset, NDArray[np.int64]], Observed],
    dataset: PoseDataset,
    split: SplitSpec,
    rows: NDArray[np.int64],
) -> Observed:
    """Return what a graph sees of copies of some frames with each of the study's noises.

    ``see`` runs frames of a data set through the graph. The copies of a kind are spread over the
    frames ``rows``; strengths are drawn, seeded by the split's seed, from 0.3 to 1 of the default.
    The ``indices`` of the result are those of the frames that were copied.
    """
    count = min(_COPIES, len(rows))
    # The kinds begin at different frames, to use more of them.
    starts = np.linspace(0.0, 1.0, len(KINDS), endpoint=False)
    steps = np.linspace(0.0, len(rows), count, endpoint=False)
    places = (starts[:, np.newaxis] * len(rows) / count + steps).astype(np.int64)
    copied = rows[np.minimum(places, len(rows) - 1)].ravel()
    names = np.repeat(list(KINDS), count)

    def read_image(number: int) -> NDArray[np.uint8]:
        generator = np.random.default_rng((split.seed, number))
        noise = drawn(str(names[number]), generator)
        return dataset.read_changed(int(copied[number]), noise.degrade, generator)

    copies = replace(
        dataset,
        poses=dataset.poses[copied],
        sequence=dataset.sequence[copied],
        frame_names=tuple(f"{dataset.frame_names[row]}/{n}" for n, row in enumerate(copied)),
        read_image=read_image,
    )
    seen = see(copies, np.arange(len(copied)))
    return replace(seen, indices=copied[seen.indices])


def fitted_difficulty(
    head: Head, entry: Threshold, clean: Observed, noisy: Observed
) -> DifficultySpec:
    """Fit log u to frames as they are and noisy copies, by ridge regression on their features.

    What is fitted is the logarithm of how far a truth is out, in units of the frame's own set at
    the threshold ``entry``, as a mean over the degrees of freedom. The median u of ``clean`` is 1.
    """
    x = np.concatenate([features(each.outputs) for each in (clean, noisy)])
    y = np.concatenate([_log_share(head, entry, each) for each in (clean, noisy)])
    centre, scale = x.mean(axis=0), x.std(axis=0) + _LEAST
    z = (x - centre) / scale
    beta = np.linalg.solve(z.T @ z + _RIDGE * np.eye(z.shape[1]), z.T @ (y - y.mean()))
    weights = _STEEPER * beta / scale
    usual = float(np.median(x[: len(clean.indices)] @ weights))
    return DifficultySpec(weights=four(weights), bias=-usual, lowest=_LOWEST, highest=_HIGHEST)


def _log_share(head: Head, entry: Threshold, frames: Observed) -> Array:
    """Return the mean over the DoF of log (distance of the truth / reach of the set), (n,).

    Both from the prediction; the reach of a set without end on that side is that of the other one.
    """
    sets = frames.sets(head, entry)
    offset = frames.truth - frames.point
    below = frames.point - np.array([each.lower for each in sets])
    above = np.array([each.upper for each in sets]) - frames.point
    own, other = np.where(offset < 0.0, (below, above), (above, below))
    reach = np.where(np.isfinite(own), own, other)
    usable = np.isfinite(reach) & (reach > 0.0)
    share = np.abs(offset) / np.where(usable, reach, np.inf)
    return np.asarray(np.log(np.maximum(share, _LEAST_SHARE)).mean(axis=1))
