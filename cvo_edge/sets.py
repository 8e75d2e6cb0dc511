"""Conformal sets: what holds the six degrees of freedom of a pose with a stated probability."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

Scope = Literal["marginal", "joint"]
SCOPES: tuple[Scope, ...] = get_args(Scope)
Bands = tuple[tuple[tuple[float, float], ...], ...]


@dataclass(frozen=True, eq=False)
class Ellipsoids:
    """A region of all six degrees of freedom: a union of ellipsoids of one shape.

    It holds y where min_j |scale^-1 (y - centres_j)| <= radius.

    Attributes
    ----------
    centres
        Shape (J, 6), in the bundle's chart, m and rad.
    scale
        Shape (6, 6), lower triangular, in units of the chart.
    radius
        In units of the scale, at least 0.
    """

    centres: NDArray[Any]
    scale: Array
    radius: float

    def distance(self, coordinates: ArrayLike) -> float:
        """Scaled distance of six coordinates (6,) to the nearest centre."""
        return float(scaled_distance(self.centres, self.scale, np.asarray(coordinates, np.float64)))

    def contains(self, coordinates: ArrayLike) -> bool:
        """Whether six coordinates (6,) lie in the region."""
        return self.distance(coordinates) <= self.radius

    def to_dict(self) -> dict[str, Any]:
        """The record's ``region``."""
        return {
            "radius": self.radius,
            "scale": self.scale.tolist(),
            "centres": self.centres.tolist(),
        }


def scaled_distance(centres: NDArray[Any], scale: NDArray[Any], y: Array) -> Array:
    """Return min_j |scale^-1 (y - centres_j)|.

    Centres (..., J, 6), lower triangular scale (..., 6, 6) and y (..., 6) -> (...). Infinite where
    the scale has no inverse: what has no extent holds nothing.
    """
    difference = y[..., np.newaxis, :] - centres.astype(np.float64)
    rows = scale.astype(np.float64)[..., np.newaxis, :, :]
    solved = np.empty_like(difference)
    squared = np.zeros(difference.shape[:-1])
    # Forward substitution, one row after the other.
    with np.errstate(all="ignore"):
        for d in range(difference.shape[-1]):
            known = (rows[..., d, :d] * solved[..., :d]).sum(axis=-1)
            solved[..., d] = (difference[..., d] - known) / rows[..., d, d]
            squared += solved[..., d] ** 2
        nearest = np.sqrt(np.nan_to_num(squared, nan=np.inf, posinf=np.inf)).min(axis=-1)
    return np.asarray(nearest)


@dataclass(frozen=True, eq=False)
class ConformalSet:
    """The set that holds each degree of freedom with the stated confidence.

    Attributes
    ----------
    lower, upper
        Shape (6,): its hull in the bundle's chart, m and rad; infinite where unbounded.
    bands
        For methods whose sets may have gaps: per DoF the disjoint intervals (low, high) in
        ascending order; None where the set is its hull.
    crossed
        Whether a correction emptied the set of some DoF, so that its middle stands for it.
    ellipsoids
        For a method with a region of all six together, in the joint scope: that region, of which
        lower and upper are the hull; None where the set is the product of its DoF's sets.
    """

    lower: Array
    upper: Array
    bands: Bands | None = None
    crossed: bool = False
    ellipsoids: Ellipsoids | None = None

    def covers(self, coordinates: ArrayLike) -> NDArray[np.bool_]:
        """Which of six coordinates (6,) lie in the set, shape (6,); gaps count as outside."""
        y = np.asarray(coordinates, dtype=np.float64)
        if self.bands is None:
            return np.asarray((self.lower <= y) & (y <= self.upper))
        return np.array(
            [
                any(low <= value <= high for low, high in row)
                for value, row in zip(y.tolist(), self.bands, strict=True)
            ]
        )

    def contains(self, coordinates: ArrayLike) -> bool:
        """Whether six coordinates (6,) lie in the region, where there is one, else in all sets."""
        if self.ellipsoids is not None:
            return self.ellipsoids.contains(coordinates)
        return bool(self.covers(coordinates).all())

    def within(self, lowest: Array, highest: Array) -> ConformalSet:
        """Return the set with its unbounded sides put at these limits, (6,) each."""
        # A finite side beyond the limit of the other one leaves a set without width.
        lower = np.where(np.isfinite(self.lower), self.lower, np.minimum(lowest, self.upper))
        upper = np.where(np.isfinite(self.upper), self.upper, np.maximum(highest, self.lower))
        bands = self.bands
        if bands is not None:
            bands = tuple(
                row if math.isfinite(row[-1][1] - row[0][0]) else ((low, high),)
                for row, low, high in zip(bands, lower.tolist(), upper.tolist(), strict=True)
            )
        return replace(self, lower=lower, upper=upper, bands=bands)

    def width(self) -> Array:
        """Measure of the set per DoF, (6,): of the union of its bands, not of their hull."""
        if self.bands is None:
            return self.upper - self.lower
        return np.array([sum(high - low for low, high in row) for row in self.bands])

    def distance(self, coordinates: ArrayLike) -> Array:
        """Distance of six coordinates (6,) to the nearest point of the set per DoF; 0 inside."""
        y = np.asarray(coordinates, dtype=np.float64)
        if self.bands is None:
            return np.asarray(np.maximum(np.maximum(self.lower - y, y - self.upper), 0.0))
        return np.array(
            [
                min(max(low - value, value - high, 0.0) for low, high in row)
                for value, row in zip(y.tolist(), self.bands, strict=True)
            ]
        )


_UNBOUNDED = ConformalSet(np.full(6, -np.inf), np.full(6, np.inf))
_UNBOUNDED.lower.setflags(write=False)
_UNBOUNDED.upper.setflags(write=False)


def unbounded_set() -> ConformalSet:
    """The set that holds everything: what is known where a check failed."""
    return _UNBOUNDED
