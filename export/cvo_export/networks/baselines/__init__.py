"""Baselines: common ways to give a network's prediction an uncertainty.

Baselines are trained, published and evaluated like methods. Their bundles use the runtime method
``cqr``, so the runtime needs no code for them.
"""

from __future__ import annotations

from cvo_export.networks.baselines import ensemble, gaussian, mc_dropout, mdn, pinball, split
from cvo_export.networks.heads.base import Method

__all__ = ["BASELINES"]

BASELINES: dict[str, Method] = {
    "mc-dropout": mc_dropout.METHOD,
    "ensemble": ensemble.METHOD,
    "gaussian": gaussian.METHOD,
    "mdn": mdn.METHOD,
    "pinball": pinball.METHOD,
    "split": split.METHOD,
}
