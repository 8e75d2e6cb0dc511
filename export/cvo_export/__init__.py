"""Training side of cvo-edge: data sets, networks, ONNX export, calibration and evaluation."""

from __future__ import annotations

__version__ = "0.1.0"

__all__ = ["__version__"]
