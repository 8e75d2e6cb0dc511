"""Conformalized joint prediction (CJP): one network gives the pose and both bounds together.

The network's bounds Q_l, Q_h carry no guarantee of their own; conformalized quantile regression
does the rest. Two scores, chosen on validation data and named in ``calibration.score``:

- ``additive`` (Romano, Patterson and Candes 2019, eq. 6): s = max(Q_l - y, y - Q_h), so the set
  is [Q_l - q, Q_h + q]; a negative q narrows.
- ``normalised`` (CQR-r, Sesia and Candes 2020): s = max((m - y)/(m - Q_l), (y - m)/(Q_h - m))
  with the point estimate m and half-widths floored, so the set is [m - q (m - Q_l),
  m + q (Q_h - m)]: frames that the network finds hard get the larger correction.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal

import msgspec
import numpy as np
from msgspec import Meta, Struct
from numpy.typing import NDArray

from cvo_edge.artifact import Calibration, SixPositive, Threshold
from cvo_edge.errors import CalibrationFileError
from cvo_edge.pose import ConformalSet

Array = NDArray[np.float64]


class CjpParameters(Struct, frozen=True, forbid_unknown_fields=True):
    """``method_parameters`` of a CJP bundle.

    ``half_width_floor``: least half-width per DoF (m, rad) in the normalised score. ``latent``: how
    the latent variable is drawn (``mean``, ``codebook`` or the paper's ``sample``, whose noise is
    an input of the model, seeded by ``noise_seed`` and the frame number). ``latent_size``: its
    dimension.
    """

    half_width_floor: SixPositive
    latent: Literal["mean", "codebook", "sample"]
    latent_size: Annotated[int, Meta(ge=1, le=4096)]
    noise_seed: Annotated[int, Meta(ge=0)]


class CjpHead:
    """Score and set of conformalized joint prediction."""

    parameters_type: ClassVar[type[Struct]] = CjpParameters
    outputs: ClassVar[Mapping[str, tuple[int, ...]]] = {
        "pose": (1, 7),
        "lower": (1, 6),
        "upper": (1, 6),
    }

    def __init__(self, calibration: Calibration) -> None:
        try:
            self.parameters = msgspec.convert(
                calibration.method_parameters, CjpParameters, strict=True
            )
        except msgspec.ValidationError as error:
            raise CalibrationFileError(f"method_parameters: {error}") from None
        score = calibration.calibration.score
        if score not in ("additive", "normalised"):
            raise CalibrationFileError(
                f"calibration.score: expected additive or normalised for cjp, found {score!r}"
            )
        self._normalised = score == "normalised"
        smallest = min(q for t in calibration.thresholds for q in (*t.q_hat, 0.0) if q is not None)
        if self._normalised and smallest < 0.0:
            raise CalibrationFileError(
                f"thresholds.q_hat: expected factors of at least 0 for the normalised score, "
                f"found {smallest}"
            )
        self._floor = np.array(self.parameters.half_width_floor)

    def extra_inputs(self, seq: int) -> Mapping[str, NDArray[np.float32]]:
        """Latent noise (1, latent_size) in ``sample`` mode, nothing otherwise."""
        if self.parameters.latent != "sample":
            return {}
        generator = np.random.default_rng((self.parameters.noise_seed, seq))
        noise = generator.standard_normal((1, self.parameters.latent_size))
        return {"latent_noise": noise.astype(np.float32)}

    def scores(self, outputs: Mapping[str, NDArray[Any]], point: Array, truth: Array) -> Array:
        """Outputs ``lower`` and ``upper`` (n, 6), point and truth (n, 6) -> scores (n, 6)."""
        lower = outputs["lower"].astype(np.float64)
        upper = outputs["upper"].astype(np.float64)
        if not self._normalised:
            return np.asarray(np.maximum(lower - truth, truth - upper))
        below = np.maximum(point - lower, self._floor)
        above = np.maximum(upper - point, self._floor)
        return np.asarray(np.maximum((point - truth) / below, (truth - point) / above))

    def region(
        self, outputs: Mapping[str, NDArray[Any]], point: Array, threshold: Threshold
    ) -> ConformalSet:
        """Outputs of one frame, point (6,) -> its set; where it is empty, its middle."""
        lower = outputs["lower"].astype(np.float64).reshape(6)
        upper = outputs["upper"].astype(np.float64).reshape(6)
        q_hat = np.array([np.inf if q is None else q for q in threshold.q_hat])
        if self._normalised:
            lower = point - q_hat * np.maximum(point - lower, self._floor)
            upper = point + q_hat * np.maximum(upper - point, self._floor)
        else:
            lower, upper = lower - q_hat, upper + q_hat
        crossed = lower > upper
        if not crossed.any():
            return ConformalSet(lower, upper)
        middle = 0.5 * (lower + upper)
        return ConformalSet(
            np.where(crossed, middle, lower), np.where(crossed, middle, upper), crossed=True
        )
