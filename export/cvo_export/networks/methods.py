"""All that can be trained, by name: the methods, and the baselines they are compared with."""

from __future__ import annotations

from cvo_export.networks.baselines import BASELINES, BaselineConfig
from cvo_export.networks.heads import METHODS, HeadConfig, Method

TRAINABLE: dict[str, Method] = METHODS | BASELINES

TrainableConfig = HeadConfig | BaselineConfig
