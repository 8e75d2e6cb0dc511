"""Relative motions of a trajectory, and how far an estimated one is off.

A pose is ``T_world_body``: tx ty tz (m) and a unit quaternion qx qy qz qw. The motion from pose a
to pose b is dT = T_a^-1 T_b. For the motions dE of the estimate and dG of the truth over the same
time, the residual is

    x = (t, Log R),  [R t; 0 1] = dE^-1 dG

in R^6: metres and a rotation vector in radians, in the body frame at the end of the estimated
motion. It does not depend on the world frames of the two trajectories, which nobody has to align.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cvo_edge import geometry

Array = NDArray[np.float64]


def motion(start: ArrayLike, end: ArrayLike) -> Array:
    """Poses (..., 7) and later poses (..., 7) -> motions T_start^-1 T_end (..., 7)."""
    first, last = np.asarray(start, np.float64), np.asarray(end, np.float64)
    back = geometry.quaternion_conjugate(first[..., 3:])
    t_m = rotated(back, last[..., :3] - first[..., :3])
    return np.concatenate([t_m, geometry.quaternion_multiply(back, last[..., 3:])], axis=-1)


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
