"""Fit the statistics of familiarity to a graph's own features, and add them to the graph.

The features come from the exported graph, in 8 bits or not, run by the runtime's engine.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import cycle
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cvo_edge.bundle.format import DEGRADATION_OUTPUT, NOVELTY_OUTPUT
from cvo_edge.engine.session import Session
from cvo_edge.errors import GateError, SourceError
from cvo_export.data.harmless import HARMLESS
from cvo_export.data.noise import KINDS, drawn
from cvo_export.datasets import PoseDataset
from cvo_export.graph.familiarity import Familiarity, Image8, fitted, neighbours, spread_pairs
from cvo_export.graph.familiarity_nodes import CELLS, PIXELS, with_familiarity

Feed = Mapping[str, NDArray[Any]]
Change = Callable[[Image8, np.random.Generator], Image8]

# Training frames behind the statistics, and copies of them.
_FRAMES, _HARMLESS, _NOISY = 1200, 150, 600
_CHECKED = 16
# The distance to the nearest frame, the first, is the root of a difference of large numbers.
_TOLERANCES = {
    NOVELTY_OUTPUT: np.array([1e-2, 1e-3, 1e-3, 1e-3]),
    DEGRADATION_OUTPUT: np.array([1e-3]),
}


def familiarised(
    content: bytes,
    dataset: PoseDataset,
    training: NDArray[np.int64],
    feed: Callable[[Image8], Feed],
    seed: int,
) -> bytes:
    """Return a graph with outputs ``cells`` and ``pixels`` with the statistics instead of them.

    ``training`` are the numbers of the training frames; ``feed`` maps an image to the graph's
    inputs. Raises GateError if the graph and the formulas disagree, and SourceError if no frame
    can be read.
    """
    session = Session(content)
    generator = np.random.default_rng(seed)

    def seen(indices: NDArray[np.int64], changes: list[Change]) -> tuple[Any, Any, Any]:
        """Return numbers, features and pixels of the frames that can be read, changed in turn."""
        kept, cells, pixels = [], [], []
        for index, change in zip(indices.tolist(), cycle(changes), strict=False):
            try:
                image = dataset.read_changed(index, change, generator)
            except SourceError:
                continue
            outputs = session.run(feed(image))
            kept.append(index)
            cells.append(outputs[CELLS])
            pixels.append(outputs[PIXELS])
        if not kept:
            raise SourceError(f"{dataset.name}: expected training frames, found none to read")
        return np.array(kept), np.concatenate(cells), np.concatenate(pixels)

    ordered = np.sort(training)
    known, cells, pixels = seen(ordered[spread_pairs(len(ordered), _FRAMES)], [_unchanged])
    copied, harmless, _ = seen(_spread(known, _HARMLESS), list(HARMLESS))
    _, noisy, _ = seen(_spread(known, _NOISY), _NOISES)
    found = fitted(
        cells,
        neighbours(known, dataset.sequence),
        (np.searchsorted(known, copied), harmless),
        noisy,
        pixels,
        seed,
    )
    written = with_familiarity(content, found)
    frames = _spread(known, _CHECKED)
    _check(Session(written), session, [feed(dataset.read_image(i)) for i in frames], found)
    return written


def _unchanged(image: Image8, _: np.random.Generator) -> Image8:
    return image


def _with_noise(name: str) -> Change:
    """Return the change to a noise of the study, at a strength drawn for each image."""

    def change(image: Image8, generator: np.random.Generator) -> Image8:
        return drawn(name, generator).degrade(image, generator)

    return change


_NOISES = [_with_noise(name) for name in KINDS]


def _spread(indices: NDArray[np.int64], most: int) -> NDArray[np.int64]:
    return indices[np.linspace(0, len(indices) - 1, min(most, len(indices))).astype(np.int64)]


def _check(after: Session, before: Session, feeds: list[Feed], found: Familiarity) -> None:
    """Raise GateError unless the graph gives what the formulas give."""
    for each in feeds:
        outputs, given = before.run(dict(each)), after.run(dict(each))
        for name, expected in (
            (NOVELTY_OUTPUT, found.novelty(outputs[CELLS], outputs[PIXELS])),
            (DEGRADATION_OUTPUT, found.degradation(outputs[CELLS])),
        ):
            off = np.abs(given[name] - expected) / np.maximum(1.0, np.abs(expected))
            # Written so that NaN is a disagreement.
            wrong = ~(off[0] <= _TOLERANCES[name])
            if wrong.any():
                number = int(wrong.argmax())
                raise GateError(
                    f"export: expected number {number} of output {name} of the graph to agree with "
                    f"its formula within {_TOLERANCES[name][number]:g}, found a difference of "
                    f"{off[0, number]:.3g}"
                )
