"""Conformalized visual odometry for the edge: a camera frame in, a pose with a true interval out.

from cvo_edge import Odometer

with Odometer.load("bundle", confidence=0.9, scope="marginal") as odometer:
    estimate = odometer.step(image_bgr)
    estimate.pose, estimate.lower, estimate.upper
"""

from __future__ import annotations

from cvo_edge.artifact import Bundle, Calibration, read_bundle
from cvo_edge.errors import (
    BundleMismatchError,
    CalibrationFileError,
    CvoError,
    GateError,
    ModelError,
    SinkError,
    SourceError,
    UsageError,
)
from cvo_edge.odometer import Odometer
from cvo_edge.pose import Chart, ConformalSet, Pose, PoseInterval, Reason, Status
from cvo_edge.sources import Frame, open_source

__version__ = "0.1.0"

__all__ = [
    "Bundle",
    "BundleMismatchError",
    "Calibration",
    "CalibrationFileError",
    "Chart",
    "ConformalSet",
    "CvoError",
    "Frame",
    "GateError",
    "ModelError",
    "Odometer",
    "Pose",
    "PoseInterval",
    "Reason",
    "SinkError",
    "SourceError",
    "Status",
    "UsageError",
    "open_source",
    "read_bundle",
]
