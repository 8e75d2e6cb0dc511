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
    from cvo_edge.pose import Chart, ConformalSet, Ellipsoids, Pose, PoseInterval, Reason, Status
    from cvo_edge.prepared import ModelCache
    from cvo_edge.records import Record, read_records
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
    "Bundle": "artifact",
    "BundleMismatchError": "errors",
    "Calibration": "artifact",
    "CalibrationFileError": "errors",
    "Chart": "pose",
    "ConformalSet": "pose",
    "CvoError": "errors",
    "Ellipsoids": "pose",
    "Frame": "sources",
    "GateError": "errors",
    "ModelCache": "prepared",
    "ModelError": "errors",
    "Odometer": "odometer",
    "Pose": "pose",
    "PoseInterval": "pose",
    "Reason": "pose",
    "Record": "records",
    "SinkError": "errors",
    "SourceError": "errors",
    "Status": "pose",
    "UsageError": "errors",
    "open_source": "sources",
    "read_bundle": "artifact",
    "read_records": "records",
}


def __getattr__(name: str) -> Any:  # noqa: ANN401 - the type is that of the name
    """Import a public name when it is first asked for.

    The command line sets up the environment of numpy and OpenCV first, and answers ``--version``
    without either.
    """
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
