"""The words that options and files choose from; importing this module costs nothing.

The command lines build their choices from these types, before numpy or a model is imported.
"""

from __future__ import annotations

from typing import Literal, get_args

# Of this package, for its records and its metadata.
VERSION = "0.1.0"

Scope = Literal["marginal", "joint"]
Mode = Literal["live", "latency", "throughput"]
Existing = Literal["replace", "append", "force"]
Format = Literal["jsonl", "csv", "tum", "table", "mcap", "rrd"]
Crop = Literal["none", "centre"]
Decode = Literal["full", "half"]
Precision = Literal["fp32", "int8"]
Provider = Literal["onnxruntime", "openvino"]
Sides = Literal["symmetric", "asymmetric", "lower", "upper"]
Joint = Literal["max", "bonferroni"]
Rule = Literal["pooled", "capped", "hierarchical"]
TrajectoryFormat = Literal["tum", "kitti", "euroc", "openvins"]
MotionFormat = Literal["jsonl", "csv", "tum"]
MotionCovariance = Literal["interval", "integrated"]
MotionCorrection = Literal["time", "frame", "scale"]
MotionEngine = Literal["local", "ray"]
MotionRule = Literal["mean", "tolerance", "capped", "hierarchical"]
SplitKind = Literal["random", "block", "sequence"]

MOTION_CORRECTIONS: tuple[MotionCorrection, ...] = get_args(MotionCorrection)
MOTION_RULES: tuple[MotionRule, ...] = get_args(MotionRule)
SCOPES: tuple[Scope, ...] = get_args(Scope)
MODES: tuple[Mode, ...] = get_args(Mode)
