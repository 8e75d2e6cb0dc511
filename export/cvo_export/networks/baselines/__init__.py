"""What the methods are compared with: common ways to give a network's answer an uncertainty.

Each is trained, published and evaluated as a method is; its bundle is one of ``cqr``, so that the
runtime knows nothing of baselines.
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
