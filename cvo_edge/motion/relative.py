"""Relative motions of a trajectory, and how far an estimated one is off.

A pose is ``T_world_body``: tx ty tz (m) and a unit quaternion qx qy qz qw. The motion from pose a
to pose b is dT = T_a^-1 T_b. For the motions dE of the estimate and dG of the truth over the same
time, the residual is

    x = (t, Log R),  [R t; 0 1] = dE^-1 dG

in R^6: metres and a rotation vector in radians, in the body frame at the end of the estimated
motion. It does not depend on the world frames of the two trajectories, which nobody has to align.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cvo_edge import geometry

Array = NDArray[np.float64]
Number = TypeVar("Number", float, Array)

_SMALL = 1e-8


def motion(start: ArrayLike, end: ArrayLike) -> Array:
    """Poses (..., 7) and later poses (..., 7) -> motions T_start^-1 T_end (..., 7)."""
    first, last = np.asarray(start, np.float64), np.asarray(end, np.float64)
    return np.stack(between(np.moveaxis(first, -1, 0), np.moveaxis(last, -1, 0)), axis=-1)


def between(start: Iterable[Number], end: Iterable[Number]) -> tuple[Number, ...]:
    """Seven numbers of a pose, and of a later one -> those of the motion T_start^-1 T_end.

    The numbers are floats, or arrays of one shape: both give the same bits.
    """
    ax, ay, az, p, q, r, s = start
    bx, by, bz, qx, qy, qz, qw = end
    # The conjugate of the rotation at the start.
    p, q, r = -p, -q, -r
    x, y, z = bx - ax, by - ay, bz - az
    # v + 2 s (u x v) + 2 u x (u x v), with the vector part u and the scalar part s.
    hx, hy, hz = q * z - r * y, r * x - p * z, p * y - q * x
    return (
        x + 2.0 * (s * hx + (q * hz - r * hy)),
        y + 2.0 * (s * hy + (r * hx - p * hz)),
        z + 2.0 * (s * hz + (p * hy - q * hx)),
        s * qx + p * qw + q * qz - r * qy,
        s * qy - p * qz + q * qw + r * qx,
        s * qz + p * qy - q * qx + r * qw,
        s * qw - p * qx - q * qy - r * qz,
    )


def rotation_vectors(x: Array, y: Array, z: Array, w: Array) -> tuple[Array, Array, Array]:
    """Four numbers of quaternions -> the three of their rotation vectors, rad, norm at most pi."""
    sine = np.sqrt(x * x + y * y + z * z)
    angle = 2.0 * np.arctan2(sine, np.abs(w))
    factor = np.where(sine > _SMALL, angle / np.maximum(sine, _SMALL), 2.0)
    factor = np.where(w < 0.0, -factor, factor)
    return factor * x, factor * y, factor * z


def rotation_vector(x: float, y: float, z: float, w: float) -> tuple[float, float, float]:
    """Do the same for one quaternion: the same bits, in a tenth of the time."""
    sine = math.sqrt(x * x + y * y + z * z)
    # numpy's arctangent, as that of ``math`` may round in another way.
    angle = 2.0 * float(np.arctan2(sine, abs(w)))
    factor = angle / sine if sine > _SMALL else 2.0
    factor = -factor if w < 0.0 else factor
    return factor * x, factor * y, factor * z


def residual(estimate: ArrayLike, truth: ArrayLike) -> Array:
    """Motions of the estimate and of the truth, (..., 7) each -> residuals x (..., 6), m and rad.

    The norms of its halves are the translation and rotation errors of the RPE (Sturm et al. 2012).
    """
    off = motion(estimate, truth)
    return np.concatenate([off[..., :3], geometry.quaternion_log(off[..., 3:])], axis=-1)


def rotated(q_xyzw: ArrayLike, vectors: ArrayLike) -> Array:
    """Unit quaternions (..., 4) and vectors (..., 3) -> rotated vectors (..., 3)."""
    q = np.asarray(q_xyzw, np.float64)
    v = np.asarray(vectors, np.float64)
    # v + 2 w (u x v) + 2 u x (u x v), with the vector part u and the scalar part w.
    half = _cross(q[..., :3], v)
    return np.asarray(v + 2.0 * (q[..., 3:] * half + _cross(q[..., :3], half)))


def norms(residuals: Array) -> Array:
    """Residuals (..., 6) -> position error in m and angle in rad (..., 2)."""
    halves = residuals.reshape(*residuals.shape[:-1], 2, 3)
    return np.asarray(np.sqrt(np.sum(halves * halves, axis=-1)))


def _cross(a: Array, b: Array) -> Array:
    # A third of the time of numpy.cross.
    ax, ay, az = np.moveaxis(a, -1, 0)
    bx, by, bz = np.moveaxis(b, -1, 0)
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=-1)
