"""The words that options of the training side choose from; importing this module costs nothing."""

from __future__ import annotations

from typing import Literal

Normalisation = Literal["half", "timm"]
Subset = Literal["test", "all"]
GivenRotation = Literal["tangent_predicted", "euler_zyx"]
StudyEngine = Literal["local", "ray"]
