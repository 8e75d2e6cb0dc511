"""How large a region is: the volume of a union of balls, by counting overlaps."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_DRAWS = 400


def union_log_volume(centres: Array, radius: float, draws: int = _DRAWS) -> float:
    """Logarithm of the volume of balls of one radius about centres (J, d).

    J times one ball's volume counts a point once for every ball that holds it; so it is multiplied
    by E[1/m], where m is that number for a point drawn from a ball drawn at random (Karp, Luby and
    Madras 1989). The draws are the same for every union, so that two are compared fairly.
    """
    count, d = centres.shape
    if radius <= 0.0:
        return -math.inf
    generator = np.random.default_rng(0)
    direction = generator.standard_normal((draws, d))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    reach = radius * generator.random((draws, 1)) ** (1.0 / d)
    drawn = centres[generator.integers(count, size=draws)]
    points = drawn + reach * direction
    # |p - c|^2 about the middle, so that the difference of squares keeps its digits.
    middle = centres.mean(axis=0)
    p, c = points - middle, centres - middle
    squared = (p**2).sum(axis=1)[:, np.newaxis] + (c**2).sum(axis=1) - 2.0 * p @ c.T
    holders = np.maximum((squared <= radius**2).sum(axis=1), 1)
    ball = 0.5 * d * math.log(math.pi) - math.lgamma(0.5 * d + 1.0)
    once = math.log((1.0 / holders).mean())
    return float(math.log(count) + ball + d * math.log(radius) + once)


def ellipsoids_log_volume(
    centres: Array, scale: Array, radius: float, draws: int = _DRAWS
) -> float:
    """The same for ellipsoids {scale v : |v| <= radius} about centres (J, d).

    scale (d, d) is lower triangular with a positive diagonal.
    """
    log_determinant = float(np.log(np.diag(scale)).sum())
    scaled = np.asarray(np.linalg.solve(scale, centres.T).T, np.float64)
    return union_log_volume(scaled, radius, draws) + log_determinant
