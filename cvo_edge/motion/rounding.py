"""How many digits ``motion.json`` keeps, of thresholds and of what they rest on."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cvo_edge.motion.fitting import Scale
from cvo_edge.motion.format import ScaleSpec

Array = NDArray[np.float64]

# Significant digits of coefficients, other numbers, thresholds and matrices: twelve horizons have
# to fit into 64 KiB.
_COEFFICIENT, _COARSE, _FINE, EXACT = 3, 4, 4, 9


def scale_of(scale: Scale) -> ScaleSpec:
    """Return coefficients and ranges as the file keeps them."""
    return ScaleSpec(
        coefficients=coefficients_of(scale.coefficients),
        lowest=numbers_of(scale.lowest),
        highest=numbers_of(scale.highest),
    )


def coefficients_of(values: Array) -> tuple[tuple[float, ...], ...]:
    """Return the coefficients (k, d) of a bias or a scale, which need not be exact."""
    return tuple(tuple(rounded(each, _COEFFICIENT) for each in row) for row in values.tolist())


def thresholds_of(values: Array) -> tuple[float | None, ...]:
    """Return thresholds; None for those that are infinite."""
    # Rounded up: rounding must not exclude a score.
    return tuple(
        rounded(q * (1.0 + 10.0 ** (1 - _FINE)) + 1e-12, _FINE) if np.isfinite(q) else None
        for q in values.tolist()
    )


def numbers_of(values: Array) -> tuple[float, ...]:
    """Return several numbers."""
    return tuple(map(rounded, values.tolist()))


def rounded(value: float, digits: int = _COARSE) -> float:
    """Return a number with fewer digits."""
    return float(f"{value:.{digits}g}")
