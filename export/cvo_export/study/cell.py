"""The figures of one cell: a run that was trained, calibrated and evaluated."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from msgspec import Struct

CONFIDENCE = 0.9


class Width(Struct, frozen=True, forbid_unknown_fields=True):
    """Means over three degrees of freedom each: metres, and degrees."""

    m: float
    deg: float


class Figures(Struct, frozen=True, forbid_unknown_fields=True):
    """Sets of 90 % on the test frames; coverage per DoF, their mean, and of all six at once.

    Widths and score bound an unbounded side by the workspace; ``unbounded`` is the share of frames
    that have such a side, None for a network's own bounds, which are finite.
    """

    coverage: list[float]
    mean_coverage: float
    joint_coverage: float
    mean_width: Width
    median_width: Width
    normalised_interval_score: float
    unbounded: float | None

    @classmethod
    def of(cls, level: Mapping[str, Any]) -> Figures:
        """Return the figures of one level, or of the own bounds, in a report of ``evaluate``."""

        def width(key: str) -> Width:
            values = np.array(level[key])
            return Width(float(values[:3].mean()), float(np.rad2deg(values[3:].mean())))

        return cls(
            coverage=level["coverage"],
            mean_coverage=float(np.mean(level["coverage"])),
            joint_coverage=level["joint_coverage"],
            mean_width=width("mean_width"),
            median_width=width("median_width"),
            normalised_interval_score=level["normalised_interval_score"],
            unbounded=level.get("unbounded_share"),
        )


class NoiseFigures(Struct, frozen=True, forbid_unknown_fields=True):
    """Marginal sets on noisy test frames, at thresholds of clean frames and of noisy ones.

    Figures are of the frames that passed the checks; ``invalid`` counts the others.
    """

    invalid: int
    point_error: dict[str, float]
    clean: Figures
    recalibrated: Figures


class Seconds(Struct, frozen=True, forbid_unknown_fields=True):
    """Training time, without the features of the pretrained network."""

    processor: float
    wall: float


class Cell(Struct, frozen=True, forbid_unknown_fields=True):
    """Figures of one run.

    Attributes
    ----------
    options
        Digest of the run's configuration.
    bundle
        Digest of its bundle.
    marginal, joint, own
        Calibrated sets of both scopes; the network's own bounds before calibration, if it has any.
    joint_volume
        Volume of the joint sets, in standardised units.
    training
        None for a run that was interrupted, whose time is not known.
    head_parameters, graph_parameters
        Trained numbers behind the features, and in all; a forest's trees do not count.
    model_bytes
        Size of the ONNX file.
    adaptiveness
        How closely the widths of the marginal sets follow errors; see ``cvo_export.evaluate``.
    pieces
        Share of the marginal sets that are in pieces; None for methods whose sets never are.
    noise
        Figures on noisy test frames, by name and strength of the noise; None where no frame passed
        the checks.
    """

    method: str
    seed: int
    options: str
    bundle: str
    score: str
    frames: dict[str, int]
    marginal: Figures
    joint: Figures
    own: Figures | None
    joint_volume: dict[str, float]
    point_error: dict[str, float]
    training: Seconds | None
    head_parameters: int
    graph_parameters: int
    model_bytes: int
    adaptiveness: dict[str, float | None]
    pieces: float | None
    noise: dict[str, NoiseFigures | None] = {}
