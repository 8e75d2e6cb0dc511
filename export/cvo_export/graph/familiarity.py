"""How familiar an image is: statistics of the backbone's features, fitted to training frames.

The features of a frame are a coarse grid of K cells with C channels each. Five statistics are part
of the exported graph; ``novelty`` has four, ``degradation`` one:

``nearest``
    Distance of a cell to the nearest of 250 prototypes, which are the same cell of training frames
    (k centres, Gonzalez 1985); the largest of all cells.
``cell``, ``mean``
    Mahalanobis distance of a cell to a Gaussian of its own (PaDiM, Defard et al. 2021): the largest
    and the root mean square of all cells.
``colour``
    Mahalanobis distance of 18 colour numbers of some pixels, fitted with other exposures and
    other white balances.
``degradation``
    Logit of a logistic regression that tells noisy copies from clean frames by the mean and the
    standard deviation of each channel over the cells.

The metric of ``nearest`` is the covariance of what may change: differences between neighbouring
training frames, and between frames and harmless copies of them. A generalised eigenproblem
(S_total v = lambda S_change v) gives one projection z per cell in which both metrics are diagonal:
z is white for changes and has variances lambda over the place. Prototypes keep the dimensions with
the largest lambda; in the others the place looks the same everywhere.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Image8 = NDArray[np.uint8]

PROTOTYPES, _TOP = 250, 32
# More channels are first reduced to their largest principal components.
_CHANNELS = 128
# Share of the mean variance that keeps covariances of few frames invertible.
_SHRINKAGE = 0.05
# Other exposures (stops) and white balances (gain per channel) of the colour numbers.
_STOPS, _BALANCE, _COLOUR_COPIES = 0.5, 0.07, 8
# An image's values are proportional to about the 2.2nd root of light.
_GAMMA = 2.2
_RIDGE, _NEWTON_STEPS = 1.0, 20
_LEAST = 1e-6
LARGEST_NOVELTY, LARGEST_LOGIT = 1e6, 50.0
# Lightness and two opponent colours of a pixel (r, g, b) in 0 to 255.
OPPONENT = np.array([[1, 1, 1], [1, 0, -1], [-0.5, 1, -0.5]]).T / np.array([3.0, 1.0, 1.0]) / 255.0
# Which of the nine covariances of three colours are kept.
COVARIANCES = (0, 1, 2, 4, 5, 8)


@dataclass(frozen=True)
class Familiarity:
    """The fitted constants; K cells, C channels after ``basis``, P prototypes in r dimensions.

    Attributes
    ----------
    basis
        (raw channels, C), or None if there are few channels.
    mean, projection, precision
        (K, C), (K, C, C) and (K, C): z = (f - mean) @ projection, whitened and over sqrt(C), so
        that sums of squares are means; 1 / lambda.
    prototypes
        (K, P, r): in the first r dimensions of z.
    weights, bias
        (2 C,) and a number: the logistic regression on means and deviations.
    colour_mean, colour_whitening
        (18,) and (18, 18): numbers - mean, times whitening, whose squares sum to their mean.
    """

    basis: Array | None
    mean: Array
    projection: NDArray[np.float16]
    precision: Array
    prototypes: NDArray[np.float16]
    weights: Array
    bias: float
    colour_mean: Array
    colour_whitening: Array

    def novelty(self, cells: NDArray[np.float32], pixels: NDArray[Any]) -> Array:
        """Cells (n, K, raw channels) and pixels (n, rows, columns, 3) RGB -> (n, 4)."""
        z = self.projected(cells)
        deviation = np.einsum("nkc,kc->nk", np.square(z), self.precision)
        top = self.prototypes.shape[2]
        prototypes = self.prototypes.astype(np.float64)
        squared = (
            np.square(prototypes).sum(axis=2)
            - 2.0 * np.einsum("nkr,kpr->nkp", z[..., :top], prototypes)
        ).min(axis=2) + np.square(z).sum(axis=2)
        whitened = (colour_numbers(pixels) - self.colour_mean) @ self.colour_whitening
        squares = (
            squared.max(axis=1),
            deviation.max(axis=1),
            deviation.mean(axis=1),
            np.square(whitened).sum(axis=1),
        )
        return np.asarray(np.sqrt(np.clip(np.stack(squares, axis=1), 0.0, LARGEST_NOVELTY**2)))

    def degradation(self, cells: NDArray[np.float32]) -> Array:
        """Cells (n, K, raw channels) -> (n, 1)."""
        logit = summary(self.reduced(cells)) @ self.weights + self.bias
        return np.asarray(np.clip(logit, -LARGEST_LOGIT, LARGEST_LOGIT)[:, np.newaxis])

    def reduced(self, cells: NDArray[np.float32]) -> Array:
        """Cells (n, K, raw channels) -> (n, K, C)."""
        return _reduced(cells, self.basis)

    def projected(self, cells: NDArray[np.float32]) -> Array:
        """Cells (n, K, raw channels) -> z (n, K, C)."""
        centred = self.reduced(cells) - self.mean
        return np.asarray(np.einsum("nkc,kcd->nkd", centred, self.projection.astype(np.float64)))


def fitted(
    cells: NDArray[np.float32],
    pairs: NDArray[np.int64],
    harmless: tuple[NDArray[np.int64], NDArray[np.float32]],
    noisy: NDArray[np.float32],
    pixels: Image8,
    seed: int,
) -> Familiarity:
    """Fit the statistics to training frames.

    Parameters
    ----------
    cells, pixels
        Features (n, K, channels) and some pixels (n, rows, columns, 3) of training frames.
    pairs
        Rows (m, 2) of neighbouring frames.
    harmless
        Rows (h,) of frames that have harmless copies, and the copies' features (h, K, channels).
    noisy
        Features of noisy copies of training frames, (q, K, channels).
    """
    basis = _basis(cells)

    known, copied = _reduced(cells, basis), _reduced(harmless[1], basis)
    mean = known.mean(axis=0)
    # A difference of two frames has twice the variance of either.
    changes = np.concatenate(
        [
            (known[pairs[:, 1]] - known[pairs[:, 0]]) / np.sqrt(2.0),
            copied - known[harmless[0]],
        ]
    )
    projections, variances = zip(
        *(_diagonalised(known[:, k], changes[:, k]) for k in range(known.shape[1])), strict=True
    )
    channels = known.shape[2]
    projection = (np.array(projections) / np.sqrt(channels)).astype(np.float16)
    z = np.einsum("nkc,kcd->nkd", known - mean, projection.astype(np.float64))
    top = min(_TOP, channels)
    prototypes = np.stack([_centres(z[:, k, :top], PROTOTYPES) for k in range(z.shape[1])])
    clean = np.concatenate([summary(known), summary(copied)])
    weights, bias = _logistic(clean, summary(_reduced(noisy, basis)))
    colours = colour_numbers(_recoloured(pixels, seed))
    return Familiarity(
        basis=basis,
        mean=mean,
        projection=projection,
        precision=1.0 / np.array(variances),
        prototypes=prototypes.astype(np.float16),
        weights=weights,
        bias=bias,
        colour_mean=colours.mean(axis=0),
        colour_whitening=_whitening(colours),
    )


def _reduced(cells: NDArray[np.float32], basis: Array | None) -> Array:
    found = cells.astype(np.float64)
    return found if basis is None else found @ basis


def _basis(cells: NDArray[np.float32]) -> Array | None:
    """Return the largest principal components, or None if there are few channels."""
    channels = cells.shape[2]
    if channels <= _CHANNELS:
        return None
    rows = cells.reshape(-1, channels).astype(np.float64)
    _, vectors = np.linalg.eigh(np.cov(rows, rowvar=False))
    return np.asarray(vectors[:, : -_CHANNELS - 1 : -1])


def _shrunk(rows: Array) -> Array:
    """Return the second moments of rows (n, C) about zero, kept invertible."""
    moments = rows.T @ rows / max(1, len(rows))
    return np.asarray(
        moments + (_SHRINKAGE * np.trace(moments) / len(moments) + _LEAST) * np.eye(len(moments))
    )


def _diagonalised(known: Array, changes: Array) -> tuple[Array, Array]:
    """Return the projection (C, C) that whitens changes, and the variances (C,) of known frames.

    Rows (n, C); variances descend.
    """
    lower = np.linalg.cholesky(_shrunk(changes))
    inverse = np.linalg.inv(lower)
    values, vectors = np.linalg.eigh(inverse @ _shrunk(known - known.mean(axis=0)) @ inverse.T)
    return inverse.T @ vectors[:, ::-1], np.maximum(values[::-1], _LEAST)


def _centres(points: Array, count: int) -> Array:
    """Return ``count`` of the points (n, r) that cover all of them, repeated if there are fewer."""
    chosen = [int(np.square(points - points.mean(axis=0)).sum(axis=1).argmin())]
    nearest = np.square(points - points[chosen[0]]).sum(axis=1)
    while len(chosen) < min(count, len(points)):
        chosen.append(int(nearest.argmax()))
        nearest = np.minimum(nearest, np.square(points - points[chosen[-1]]).sum(axis=1))
    return np.resize(points[chosen], (count, points.shape[1]))


def summary(cells: Array) -> Array:
    """Cells (n, K, C) -> each channel's mean and standard deviation, (n, 2 C)."""
    return np.concatenate([cells.mean(axis=1), cells.std(axis=1)], axis=1)


def _logistic(clean: Array, noisy: Array) -> tuple[Array, float]:
    """Return weights and bias of a ridge logistic regression, by Newton's method.

    Both kinds have the same weight, whatever their numbers.
    """
    rows = np.concatenate([clean, noisy])
    centre, scale = rows.mean(axis=0), rows.std(axis=0) + _LEAST
    x = np.hstack([(rows - centre) / scale, np.ones((len(rows), 1))])
    y = np.repeat([0.0, 1.0], [len(clean), len(noisy)])
    share = np.repeat([0.5 / len(clean), 0.5 / len(noisy)], [len(clean), len(noisy)]) * len(rows)
    penalty = np.diag([_RIDGE] * (x.shape[1] - 1) + [0.0])
    beta = np.zeros(x.shape[1])
    for _ in range(_NEWTON_STEPS):
        p = 1.0 / (1.0 + np.exp(-np.clip(x @ beta, -LARGEST_LOGIT, LARGEST_LOGIT)))
        gradient = x.T @ (share * (p - y)) + penalty @ beta
        curvature = (x * (share * np.maximum(p * (1.0 - p), _LEAST))[:, np.newaxis]).T @ x + penalty
        step = np.linalg.solve(curvature, gradient)
        beta -= step
        if np.abs(step).max() < _LEAST:
            break
    weights = beta[:-1] / scale
    return weights, float(beta[-1] - centre @ weights)


def colour_numbers(pixels: NDArray[np.generic]) -> Array:
    """Pixels (n, rows, columns, 3) RGB -> (n, 18).

    Mean lightness and opponent colours of the four quarters, then the six covariances of all.
    """
    n, rows, columns, _ = pixels.shape
    colours = pixels.reshape(n, rows * columns, 3).astype(np.float64) @ OPPONENT
    means = quarters(rows, columns) @ colours
    centred = colours - colours.mean(axis=1, keepdims=True)
    covariance = centred.transpose(0, 2, 1) @ centred / (rows * columns)
    kept = covariance.reshape(n, 9)[:, COVARIANCES]
    return np.concatenate([means.reshape(n, 12), kept], axis=1)


def quarters(rows: int, columns: int) -> Array:
    """Return the matrix (4, rows * columns) of the means over the four quarters of an image."""
    row, column = np.divmod(np.arange(rows * columns), columns)
    quarter = 2 * (2 * row >= rows) + (2 * column >= columns)
    member = quarter == np.arange(4)[:, np.newaxis]
    return np.asarray(member / np.maximum(member.sum(axis=1, keepdims=True), 1))


def in_rgb(weights: Array) -> Array:
    """Weights (18, m) of ``colour_numbers`` -> weights (21, m) of means and covariances in RGB.

    That is, of the means (4, 3) of the quarters and of all nine covariances (3, 3).
    """
    means, kept = weights[:12].reshape(4, 3, -1), weights[12:]
    covariances = np.kron(OPPONENT, OPPONENT)[:, COVARIANCES] @ kept
    return np.concatenate([(OPPONENT @ means).reshape(12, -1), covariances])


def _recoloured(pixels: Image8, seed: int) -> NDArray[np.float64]:
    """Return copies of pixels (n, rows, columns, 3) under other exposures and white balances."""
    generator = np.random.default_rng(seed)
    count = (_COLOUR_COPIES * len(pixels), 1, 1)
    stops = generator.uniform(-_STOPS, _STOPS, (*count, 1))
    balance = 1.0 + generator.uniform(-_BALANCE, _BALANCE, (*count, 3))
    gain = 2.0 ** (stops / _GAMMA) * balance
    return np.minimum(np.tile(pixels, (_COLOUR_COPIES, 1, 1, 1)) * gain, 255.0)


def _whitening(rows: Array) -> Array:
    """Return W with W W^T the inverse covariance of rows (n, C), over C."""
    scale = rows.std(axis=0) + _LEAST
    scaled = (rows - rows.mean(axis=0)) / scale
    # Colour numbers have units of their own: the shrinkage works on correlations.
    scale *= np.sqrt(rows.shape[1])
    return np.asarray(np.linalg.inv(np.linalg.cholesky(_shrunk(scaled))).T / scale[:, np.newaxis])


def neighbours(indices: NDArray[np.int64], sequence: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return rows (m, 2) of frames that follow each other in one sequence; ``indices`` ascend."""
    follows = sequence[indices[1:]] == sequence[indices[:-1]]
    first = np.flatnonzero(follows)
    return np.stack([first, first + 1], axis=1)


def spread_pairs(count: int, most: int) -> NDArray[np.int64]:
    """Return at most ``most`` of ``count`` positions, ascending, as pairs of neighbours."""
    if count <= most:
        return np.arange(count)
    anchors = np.linspace(0, count - 2, most // 2).astype(np.int64)
    return np.unique(np.concatenate([anchors, anchors + 1]))
