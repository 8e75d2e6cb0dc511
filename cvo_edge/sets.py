"""Conformal sets, which hold the six degrees of freedom of a pose with a stated probability."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

Bands = tuple[tuple[tuple[float, float], ...], ...]


@dataclass(frozen=True, eq=False)
class Ellipsoids:
    """A region of all six degrees of freedom: a union of ellipsoids of equal shape.

    It contains y if min_j |scale^-1 (y - centres_j)| <= radius.

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
        """Return the scaled distance from six coordinates (6,) to the nearest centre."""
        return float(scaled_distance(self.centres, self.scale, np.asarray(coordinates, np.float64)))

    def contains(self, coordinates: ArrayLike) -> bool:
        """Whether six coordinates (6,) lie in the region."""
        return self.distance(coordinates) <= self.radius


def scaled_distance(centres: NDArray[Any], scale: NDArray[Any], y: Array) -> Array:
    """Return min_j |scale^-1 (y - centres_j)|.

    Centres (..., J, 6), lower triangular scale (..., 6, 6) and y (..., 6) -> (...). The distance is
    infinite if the scale is singular: such an ellipsoid has no volume.
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
        Shape (6,): hull of the set in the bundle's chart, m and rad; infinite where unbounded.
    bands
        For methods whose sets may have gaps: the disjoint intervals (low, high) of each DoF in
        ascending order; None if the set equals its hull.
    crossed
        Whether a correction emptied the set of some DoF, which then is its midpoint.
    ellipsoids
        The joint region of all six DoF, whose hull is given by ``lower`` and ``upper``; None if the
        set is the product of six sets.
    """

    lower: Array
    upper: Array
    bands: Bands | None = None
    crossed: bool = False
    ellipsoids: Ellipsoids | None = None

    def covers(self, coordinates: ArrayLike) -> NDArray[np.bool_]:
        """Tell which of six coordinates (6,) lie in the set, shape (6,); gaps are outside."""
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
        """Whether six coordinates (6,) lie in the region or, without a region, in all six sets."""
        if self.ellipsoids is not None:
            return self.ellipsoids.contains(coordinates)
        return bool(self.covers(coordinates).all())

    def within(self, lowest: Array, highest: Array) -> ConformalSet:
        """Return the set with its unbounded sides moved to these limits, (6,) each."""
        # If the finite side lies beyond the limit of the unbounded one, the set has zero width.
        lower = np.where(np.isfinite(self.lower), self.lower, np.minimum(lowest, self.upper))
        upper = np.where(np.isfinite(self.upper), self.upper, np.maximum(highest, self.lower))
        bands = self.bands
        if bands is not None:
            bands = tuple(
                row if math.isfinite(row[-1][1] - row[0][0]) else ((low, high),)
                for row, low, high in zip(bands, lower.tolist(), upper.tolist(), strict=True)
            )
        return replace(self, lower=lower, upper=upper, bands=bands)

    def trimmed(self, turn: ArrayLike) -> ConformalSet:
        """Return the set without rotations beyond half a turn from three coordinates (3,).

        No pose has such coordinates, so coverage is the same. Infinite sides stay.
        """
        about = np.asarray(turn, dtype=np.float64).tolist()
        sides = [*zip(about * 2, [*self.lower[3:].tolist(), *self.upper[3:].tolist()], strict=True)]
        for at, bound in sides:
            if math.pi < abs(bound - at) < math.inf:
                break
        else:
            return self
        low, high = np.split(np.array([_trimmed(at, bound) for at, bound in sides]), 2)
        bands = self.bands
        if bands is not None:
            turns = [_trimmed_bands(at, row) for at, row in zip(about, bands[3:], strict=True)]
            bands = (*bands[:3], *turns)
            low, high = np.array([(row[0][0], row[-1][1]) for row in turns]).T
        lower, upper = np.r_[self.lower[:3], low], np.r_[self.upper[:3], high]
        return replace(self, lower=lower, upper=upper, bands=bands)

    def moved(self, offset_m: Array) -> ConformalSet:
        """Return the set with all positions moved by an offset (3,), in float64."""
        step = np.concatenate([offset_m, np.zeros(3)])
        bands, ellipsoids = self.bands, self.ellipsoids
        if bands is not None:
            bands = tuple(
                tuple((low + by, high + by) for low, high in row)
                for row, by in zip(bands, step.tolist(), strict=True)
            )
        if ellipsoids is not None:
            ellipsoids = replace(ellipsoids, centres=ellipsoids.centres + step)
        return replace(
            self,
            lower=self.lower + step,
            upper=self.upper + step,
            bands=bands,
            ellipsoids=ellipsoids,
        )

    def stretched(self, point: Array, factor: float) -> ConformalSet:
        """Return {point + factor (y - point) : y in the set}, for a point (6,) and a factor > 0."""
        bands, ellipsoids = self.bands, self.ellipsoids
        if bands is not None:
            bands = tuple(
                tuple((at + factor * (low - at), at + factor * (high - at)) for low, high in row)
                for row, at in zip(bands, point.tolist(), strict=True)
            )
        if ellipsoids is not None:
            ellipsoids = replace(
                ellipsoids,
                centres=point + factor * (ellipsoids.centres - point),
                scale=factor * ellipsoids.scale,
            )
        # For six numbers plain Python is faster than numpy.
        centre = point.tolist()
        lower, upper = (
            np.array([at + factor * (y - at) for at, y in zip(centre, side.tolist(), strict=True)])
            for side in (self.lower, self.upper)
        )
        return ConformalSet(lower, upper, bands, self.crossed, ellipsoids)

    def width(self) -> Array:
        """Return the width per DoF, (6,): the total length of the bands, not of their hull."""
        if self.bands is None:
            return self.upper - self.lower
        return np.array([sum(high - low for low, high in row) for row in self.bands])

    def distance(self, coordinates: ArrayLike) -> Array:
        """Return the distance from six coordinates (6,) to the set, per DoF; 0 inside."""
        y = np.asarray(coordinates, dtype=np.float64)
        if self.bands is None:
            return np.asarray(np.maximum(np.maximum(self.lower - y, y - self.upper), 0.0))
        return np.array(
            [
                min(max(low - value, value - high, 0.0) for low, high in row)
                for value, row in zip(y.tolist(), self.bands, strict=True)
            ]
        )


def _trimmed(at: float, bound: float) -> float:
    """Return a finite bound within half a turn of a coordinate."""
    return min(max(bound, at - math.pi), at + math.pi) if math.isfinite(bound) else bound


def _trimmed_bands(
    at: float, row: tuple[tuple[float, float], ...]
) -> tuple[tuple[float, float], ...]:
    """Return the bands within half a turn of a coordinate; an end where there are none."""
    near = [(low, high) for low, high in row if low <= at + math.pi and high >= at - math.pi]
    return tuple((_trimmed(at, low), _trimmed(at, high)) for low, high in near or row[:1])


_UNBOUNDED = ConformalSet(np.full(6, -np.inf), np.full(6, np.inf))
_UNBOUNDED.lower.setflags(write=False)
_UNBOUNDED.upper.setflags(write=False)


def unbounded_set() -> ConformalSet:
    """Return the set that holds everything, used if a check failed."""
    return _UNBOUNDED
