"""Which images to match: neighbours in time, and images that show the same part of the place.

Few images are matched exhaustively. Otherwise an image is matched with the next ones of its
recording and with those that lie a power of two ahead, which bridges blurred stretches; and with
the images most like it, which closes loops and joins recordings. Likeness is that of VLAD vectors
(Jegou et al. 2010) whose words are learned from these images' own keypoints, so that nothing has
to be downloaded.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cvo_export.reconstruct.recordings import frame_of

Floats = NDArray[np.float32]

# Up to so many images every pair is matched.
EXHAUSTIVE = 40
# Images matched ahead one by one, and the most alike ones.
_NEXT, _ALIKE = 6, 12
_WORDS, _SAMPLE = 64, 20_000


def sequential_pairs(names: Sequence[str]) -> set[tuple[int, int]]:
    """Return pairs (i, j), i < j, of images of one recording: 1 to 6 and 8, 16, 32, ... apart."""
    powers = itertools.takewhile(lambda gap: gap < len(names), (2**k for k in itertools.count(3)))
    gaps = [*range(1, _NEXT + 1), *powers]
    recordings = [frame_of(name)[0] for name in names]
    return {
        (i, i + gap)
        for gap in gaps
        for i in range(len(names) - gap)
        if recordings[i] == recordings[i + gap]
    }


def alike_pairs(vectors: Floats, most: int = _ALIKE) -> set[tuple[int, int]]:
    """Return pairs (i, j), i < j, of each image with the ``most`` images of the nearest vectors.

    ``vectors`` (n, d) have unit length.
    """
    likeness = vectors @ vectors.T
    np.fill_diagonal(likeness, -np.inf)
    most = min(most, len(vectors) - 1)
    nearest = np.argsort(-likeness, axis=1, kind="stable")[:, :most]
    return {(min(i, j), max(i, j)) for i, row in enumerate(nearest.tolist()) for j in row}


def vlad(descriptors: Sequence[NDArray[np.uint8]]) -> Floats:
    """Return a unit vector for each image from its SIFT descriptors (k, 128)."""
    from sklearn.cluster import MiniBatchKMeans

    roots = [_root(each) for each in descriptors]
    everything = np.concatenate(roots)
    rng = np.random.default_rng(0)
    sample = everything[rng.permutation(len(everything))[:_SAMPLE]]
    words = MiniBatchKMeans(min(_WORDS, len(sample)), random_state=0, n_init=1).fit(sample)
    vectors = np.zeros((len(roots), words.n_clusters, everything.shape[1]), np.float32)
    for vector, each in zip(vectors, roots, strict=True):
        if len(each):
            nearest = words.predict(each)
            np.add.at(vector, nearest, each - words.cluster_centers_[nearest])
    # Each word counts alike, however often a texture repeats it (Arandjelovic, Zisserman 2013).
    vectors /= np.maximum(np.linalg.norm(vectors, axis=2, keepdims=True), 1e-9)
    flat = vectors.reshape(len(roots), -1)
    return np.asarray(flat / np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-9))


def _root(descriptors: NDArray[np.uint8]) -> Floats:
    """Return unit vectors of descriptors; COLMAP's are RootSIFT already."""
    values = descriptors.astype(np.float32)
    return np.asarray(values / np.maximum(np.linalg.norm(values, axis=1, keepdims=True), 1e-9))


def image_pairs(
    names: Sequence[str], descriptors: Sequence[NDArray[np.uint8]]
) -> list[tuple[int, int]]:
    """Return the pairs (i, j), i < j, of images to match, in order."""
    if len(names) <= EXHAUSTIVE:
        return list(itertools.combinations(range(len(names)), 2))
    if not any(len(each) for each in descriptors):
        return sorted(sequential_pairs(names))
    return sorted(sequential_pairs(names) | alike_pairs(vlad(descriptors)))
