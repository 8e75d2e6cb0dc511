"""Conformalized visual odometry for the edge: a pose interval for every camera frame.

from cvo_edge import Odometer

with Odometer.load("bundle", confidence=0.9, scope="marginal") as odometer:
    estimate = odometer.step(image_bgr)
    estimate.pose, estimate.lower, estimate.upper
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from cvo_edge.vocabulary import VERSION

if TYPE_CHECKING:
    from cvo_edge.bundle.format import Calibration
    from cvo_edge.camera import Camera, read_camera
    from cvo_edge.engine.loading import Bundle, read_bundle
    from cvo_edge.engine.model_cache import ModelCache
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
    from cvo_edge.estimate import PoseInterval
    from cvo_edge.frontend.odometry import FrontEnd
    from cvo_edge.frontend.steps import Step, StepReason
    from cvo_edge.input.frame import Frame
    from cvo_edge.input.sources import open_source
    from cvo_edge.motion.intervals import MotionCalibration
    from cvo_edge.motion.records import (
        MotionDirection,
        MotionInterval,
        MotionReason,
        MotionRecord,
    )
    from cvo_edge.motion.tracker import MotionTracker
    from cvo_edge.odometer import Odometer
    from cvo_edge.output.records import Header, Records, read_records
    from cvo_edge.pose import Chart, Pose
    from cvo_edge.record import Reason, Record, Status
    from cvo_edge.sets import ConformalSet, Ellipsoids

__version__ = VERSION

__all__ = [
    "Bundle",
    "BundleMismatchError",
    "Calibration",
    "CalibrationFileError",
    "Camera",
    "Chart",
    "ConformalSet",
    "CvoError",
    "Ellipsoids",
    "Frame",
    "FrontEnd",
    "GateError",
    "Header",
    "ModelCache",
    "ModelError",
    "MotionCalibration",
    "MotionDirection",
    "MotionInterval",
    "MotionReason",
    "MotionRecord",
    "MotionTracker",
    "Odometer",
    "Pose",
    "PoseInterval",
    "Reason",
    "Record",
    "Records",
    "SinkError",
    "SourceError",
    "Status",
    "Step",
    "StepReason",
    "UsageError",
    "open_source",
    "read_bundle",
    "read_camera",
    "read_records",
]

_HOMES = {
    "Bundle": "engine.loading",
    "BundleMismatchError": "errors",
    "Calibration": "bundle.format",
    "CalibrationFileError": "errors",
    "Camera": "camera",
    "Chart": "pose",
    "ConformalSet": "sets",
    "CvoError": "errors",
    "Ellipsoids": "sets",
    "Frame": "input.frame",
    "FrontEnd": "frontend.odometry",
    "GateError": "errors",
    "Header": "output.records",
    "ModelCache": "engine.model_cache",
    "ModelError": "errors",
    "MotionCalibration": "motion.intervals",
    "MotionDirection": "motion.records",
    "MotionInterval": "motion.records",
    "MotionReason": "motion.records",
    "MotionRecord": "motion.records",
    "MotionTracker": "motion.tracker",
    "Odometer": "odometer",
    "Pose": "pose",
    "PoseInterval": "estimate",
    "Reason": "record",
    "Record": "record",
    "Records": "output.records",
    "SinkError": "errors",
    "SourceError": "errors",
    "Status": "record",
    "Step": "frontend.steps",
    "StepReason": "frontend.steps",
    "UsageError": "errors",
    "open_source": "input.sources",
    "read_bundle": "engine.loading",
    "read_camera": "camera",
    "read_records": "output.records",
}


def __getattr__(name: str) -> Any:  # noqa: ANN401 - a name of any type
    """Import a public name on first use.

    This lets the command line set environment variables before numpy and OpenCV are imported, and
    answer ``--version`` without importing them.
    """
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    """Return the public names, for completion in an interactive session."""
    return sorted([*__all__, "__version__", "__doc__"])
