"""Conformalized joint prediction (CJP): one network predicts the pose and both bounds.

The network's bounds carry no guarantee. Conformalized quantile regression (``cvo_edge.heads.cqr``,
symmetric, with the ``additive`` or ``normalised`` score) calibrates them.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta, Struct
from numpy.typing import NDArray

from cvo_edge.bundle.format import SixPositive
from cvo_edge.heads.cqr import CqrHead


class CjpParameters(Struct, frozen=True, forbid_unknown_fields=True):
    """``method_parameters`` of a CJP bundle.

    ``half_width_floor``: smallest half-width per DoF (m, rad) in the normalised score. ``latent``:
    how the latent variable is chosen (``mean``, ``codebook`` or the paper's ``sample``, whose noise
    is an input of the model, seeded by ``noise_seed`` and the frame number). ``latent_size``:
    dimension of the latent variable.
    """

    half_width_floor: SixPositive
    latent: Literal["mean", "codebook", "sample"]
    latent_size: Annotated[int, Meta(ge=1, le=4096)]
    noise_seed: Annotated[int, Meta(ge=0)]


class CjpHead(CqrHead):
    """Score and set of conformalized joint prediction: CQR applied to the network's bounds."""

    method = "cjp"
    parameters_type = CjpParameters
    score_names = ("additive", "normalised")
    parameters: CjpParameters

    def extra_inputs(self, seq: int) -> Mapping[str, NDArray[np.float32]]:
        """Return the latent noise (1, latent_size) in ``sample`` mode, otherwise nothing."""
        if self.parameters.latent != "sample":
            return {}
        generator = np.random.default_rng((self.parameters.noise_seed, seq))
        noise = generator.standard_normal((1, self.parameters.latent_size))
        return {"latent_noise": noise.astype(np.float32)}
