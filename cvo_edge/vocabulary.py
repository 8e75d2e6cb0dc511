"""The words that options and files choose from; importing this module costs nothing.

The command lines build their choices from these types, before numpy or a model is imported.
"""

from __future__ import annotations

from enum import StrEnum
from typing import Literal

Scope = Literal["marginal", "joint"]
Format = Literal["jsonl", "csv", "tum", "table"]
Crop = Literal["none", "centre"]
Precision = Literal["fp32", "int8"]
Provider = Literal["onnxruntime", "openvino"]
Sides = Literal["symmetric", "asymmetric", "lower", "upper"]
Joint = Literal["max", "bonferroni"]
SplitKind = Literal["random", "block", "sequence"]


class Mode(StrEnum):
    """What a stream is optimised for; see ``cvo_edge.scheduling``."""

    LIVE = "live"
    LATENCY = "latency"
    THROUGHPUT = "throughput"
