"""Conformalized visual odometry for the edge: a camera frame in, a pose with a true interval out.

from cvo_edge import Odometer

with Odometer.load("bundle", confidence=0.9, scope="marginal") as odometer:
    estimate = odometer.step(image_bgr)
    estimate.pose, estimate.lower, estimate.upper
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cvo_edge.bundle.format import Calibration
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
    from cvo_edge.estimate import PoseInterval, Reason, Status
    from cvo_edge.input.frame import Frame
    from cvo_edge.input.sources import open_source
    from cvo_edge.odometer import Odometer
    from cvo_edge.output.records import Record, read_records
    from cvo_edge.pose import Chart, Pose
    from cvo_edge.sets import ConformalSet, Ellipsoids

__version__ = "0.1.0"

__all__ = [
    "Bundle",
    "BundleMismatchError",
    "Calibration",
    "CalibrationFileError",
    "Chart",
    "ConformalSet",
    "CvoError",
    "Ellipsoids",
    "Frame",
    "GateError",
    "ModelCache",
    "ModelError",
    "Odometer",
    "Pose",
    "PoseInterval",
    "Reason",
    "Record",
    "SinkError",
    "SourceError",
    "Status",
    "UsageError",
    "open_source",
    "read_bundle",
    "read_records",
]

_HOMES = {
    "Bundle": "engine.loading",
    "BundleMismatchError": "errors",
    "Calibration": "bundle.format",
    "CalibrationFileError": "errors",
    "Chart": "pose",
    "ConformalSet": "sets",
    "CvoError": "errors",
    "Ellipsoids": "sets",
    "Frame": "input.frame",
    "GateError": "errors",
    "ModelCache": "engine.model_cache",
    "ModelError": "errors",
    "Odometer": "odometer",
    "Pose": "pose",
    "PoseInterval": "estimate",
    "Reason": "estimate",
    "Record": "output.records",
    "SinkError": "errors",
    "SourceError": "errors",
    "Status": "estimate",
    "UsageError": "errors",
    "open_source": "input.sources",
    "read_bundle": "engine.loading",
    "read_records": "output.records",
}


def __getattr__(name: str) -> Any:  # noqa: ANN401 - the type is that of the name
    """Import a public name when it is first asked for.

    The command line sets up the environment of numpy and OpenCV first, and answers ``--version``
    without either.
    """
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
