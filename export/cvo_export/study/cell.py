"""The figures of one cell: a run that has been trained, calibrated and evaluated."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from msgspec import Struct

CONFIDENCE = 0.9


class Width(Struct, frozen=True, forbid_unknown_fields=True):
    """Mean widths: metres over x, y, z and degrees over the rotations."""

    m: float
    deg: float


class Figures(Struct, frozen=True, forbid_unknown_fields=True):
    """Figures of 90 % sets on the test frames: coverage per DoF, their mean, and jointly.

    Widths and score limit an unbounded side to the workspace; ``unbounded`` is the share of frames
    with such a side, None for a network's own bounds, which are finite.
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
        """Extract the figures of one level, or of the own bounds, from a report of ``evaluate``."""

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
    """Figures of marginal sets on noisy test frames, with clean and with noisy thresholds.

    They cover the frames that passed the checks; ``invalid`` counts the others.
    """

    invalid: int
    point_error: dict[str, float]
    clean: Figures
    recalibrated: Figures


class Seconds(Struct, frozen=True, forbid_unknown_fields=True):
    """Training time, excluding the features of the pretrained network."""

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
        None for an interrupted run, whose training time is unknown.
    head_parameters, graph_parameters
        Trained parameters after the features, and in total; a forest's trees do not count.
    model_bytes
        Size of the ONNX file.
    adaptiveness
        How closely the widths of the marginal sets follow errors; see ``cvo_export.evaluate``.
    pieces
        Share of marginal sets in pieces; None for methods whose sets are always intervals.
    noise
        Figures on noisy test frames, by name and strength of the noise; None if no frame passed the
        checks.
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
