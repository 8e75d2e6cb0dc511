"""Volume of a region: a Monte Carlo estimate for a union of balls or ellipsoids."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cvo_edge.sets import Ellipsoids

Array = NDArray[np.float64]

_DRAWS = 1000


def union_log_volume(centres: Array, radius: float, seed: int, draws: int = _DRAWS) -> float:
    """Return the logarithm of the volume of a union of balls of one radius about centres (J, d).

    J times the volume of one ball counts every point once per ball that contains it. The estimate
    multiplies it by E[1/m], where m is that number of balls for a uniform point in a random ball
    (Karp, Luby and Madras 1989). Use a different seed for each frame, so that the errors of the
    estimates average out.
    """
    count, d = centres.shape
    if radius <= 0.0:
        return -math.inf
    if radius == math.inf:
        return math.inf
    generator = np.random.default_rng(seed)
    direction = generator.standard_normal((draws, d))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    reach = radius * generator.random((draws, 1)) ** (1.0 / d)
    drawn = centres[generator.integers(count, size=draws)]
    points = drawn + reach * direction
    # Shift |p - c|^2 to the mean, so that the difference of squares does not lose digits.
    middle = centres.mean(axis=0)
    p, c = points - middle, centres - middle
    squared = (p**2).sum(axis=1)[:, np.newaxis] + (c**2).sum(axis=1) - 2.0 * p @ c.T
    holders = np.maximum((squared <= radius * radius).sum(axis=1), 1)
    ball = 0.5 * d * math.log(math.pi) - math.lgamma(0.5 * d + 1.0)
    once = math.log((1.0 / holders).mean())
    return float(math.log(count) + ball + d * math.log(radius) + once)


def ellipsoids_log_volume(region: Ellipsoids, seed: int) -> float:
    """Return the logarithm of the volume of a union of ellipsoids, in m^3 rad^3."""
    solved = np.linalg.solve(region.scale, region.centres.astype(np.float64).T)
    centres = np.asarray(solved.T, np.float64)
    log_determinant = float(np.log(np.abs(np.diag(region.scale))).sum())
    return union_log_volume(centres, region.radius, seed) + log_determinant
