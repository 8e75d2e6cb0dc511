"""Rotations on arrays: SO(3) and unit quaternions, batched over leading axes.

Quaternions are scalar-last (qx qy qz qw), unit, with qw >= 0. A rotation vector is axis times
angle in radians, with norm at most pi. Euler angles are intrinsic Z-Y-X, given as roll, pitch, yaw:
``R = Rz(yaw) @ Ry(pitch) @ Rx(roll)``. The functions are independent of reference frames; callers
state them in names such as ``R_a_b``.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

_SMALL_ANGLE = 1e-8


def wrap_angle(angle: ArrayLike) -> Array:
    """Wrap angles (any shape, rad) into [-pi, pi]."""
    values = np.asarray(angle, dtype=np.float64)
    return np.asarray(values - 2.0 * np.pi * np.round(values / (2.0 * np.pi)))


def quaternion_normalise(q_xyzw: ArrayLike) -> Array:
    """Quaternions (..., 4) -> unit quaternions with qw >= 0 for the same rotation.

    A zero or non-finite quaternion, which is not a rotation, gives NaN.
    """
    q = np.asarray(q_xyzw, dtype=np.float64)
    norm = np.linalg.norm(q, axis=-1, keepdims=True)
    with np.errstate(divide="ignore", invalid="ignore"):
        unit = q / norm
    return np.asarray(np.where(unit[..., 3:] < 0.0, -unit, unit))


def quaternion_multiply(p_xyzw: ArrayLike, q_xyzw: ArrayLike) -> Array:
    """Return the Hamilton product of quaternions (..., 4): the rotation q followed by p."""
    px, py, pz, pw = np.moveaxis(np.asarray(p_xyzw, dtype=np.float64), -1, 0)
    qx, qy, qz, qw = np.moveaxis(np.asarray(q_xyzw, dtype=np.float64), -1, 0)
    return np.stack(
        [
            pw * qx + px * qw + py * qz - pz * qy,
            pw * qy - px * qz + py * qw + pz * qx,
            pw * qz + px * qy - py * qx + pz * qw,
            pw * qw - px * qx - py * qy - pz * qz,
        ],
        axis=-1,
    )


def quaternion_conjugate(q_xyzw: ArrayLike) -> Array:
    """Return the inverse rotations of unit quaternions (..., 4)."""
    return np.asarray(np.multiply(q_xyzw, (-1.0, -1.0, -1.0, 1.0), dtype=np.float64))


def quaternion_exp(rotvec: ArrayLike) -> Array:
    """Rotation vectors (..., 3), rad -> unit quaternions (..., 4), qw >= 0."""
    v = np.asarray(rotvec, dtype=np.float64)
    angle = np.linalg.norm(v, axis=-1, keepdims=True)
    # sinc keeps full precision near zero: sin(a/2)/a = 0.5 * sinc(a / (2 pi)).
    xyz = 0.5 * np.sinc(angle / (2.0 * np.pi)) * v
    return quaternion_normalise(np.concatenate([xyz, np.cos(0.5 * angle)], axis=-1))


def quaternion_log(q_xyzw: ArrayLike) -> Array:
    """Unit quaternions (..., 4) -> rotation vectors (..., 3), rad, norm at most pi."""
    q = quaternion_normalise(q_xyzw)
    xyz, w = q[..., :3], q[..., 3:]
    sine = np.linalg.norm(xyz, axis=-1, keepdims=True)
    half = np.arctan2(sine, w)
    factor = np.where(sine > _SMALL_ANGLE, 2.0 * half / np.maximum(sine, _SMALL_ANGLE), 2.0)
    return np.asarray(factor * xyz)


def quaternion_to_matrix(q_xyzw: ArrayLike) -> Array:
    """Unit quaternions (..., 4) -> rotation matrices (..., 3, 3)."""
    x, y, z, w = np.moveaxis(np.asarray(q_xyzw, dtype=np.float64), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def matrix_to_quaternion(R: ArrayLike) -> Array:
    """Rotation matrices (..., 3, 3) -> unit quaternions (..., 4), qw >= 0.

    Dividing by the largest of the four components (Shepperd 1978) avoids singularities.
    """
    m = np.asarray(R, dtype=np.float64)
    m00, m11, m22 = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    transposed = np.swapaxes(m, -1, -2)
    plus, minus = m + transposed, transposed - m
    xy, xz, yz = plus[..., 0, 1], plus[..., 0, 2], plus[..., 1, 2]
    xw, yw, zw = minus[..., 1, 2], minus[..., 2, 0], minus[..., 0, 1]
    # Row i holds 4 q_i q_j for all j: any row, normalised, is the quaternion.
    table = [
        [1 + m00 - m11 - m22, xy, xz, xw],
        [xy, 1 - m00 + m11 - m22, yz, yw],
        [xz, yz, 1 - m00 - m11 + m22, zw],
        [xw, yw, zw, 1 + m00 + m11 + m22],
    ]
    rows = np.stack([np.stack(row, axis=-1) for row in table], axis=-2)
    largest = np.argmax(np.diagonal(rows, axis1=-2, axis2=-1), axis=-1)
    chosen = np.take_along_axis(rows, largest[..., None, None], axis=-2)[..., 0, :]
    return quaternion_normalise(chosen)


def matrix_to_euler_zyx(R: ArrayLike) -> Array:
    """Rotation matrices (..., 3, 3) -> roll, pitch, yaw (..., 3), rad.

    Within about 1e-6 rad of pitch = +-pi/2, roll and yaw are not unique and roll is set to 0.
    """
    m = np.asarray(R, dtype=np.float64)
    horizontal = np.hypot(m[..., 0, 0], m[..., 1, 0])
    pitch = np.arctan2(-m[..., 2, 0], horizontal)
    regular = horizontal > 1e-6
    roll = np.where(regular, np.arctan2(m[..., 2, 1], m[..., 2, 2]), 0.0)
    yaw = np.where(
        regular,
        np.arctan2(m[..., 1, 0], m[..., 0, 0]),
        np.arctan2(-m[..., 0, 1], m[..., 1, 1]),
    )
    return np.stack([roll, pitch, yaw], axis=-1)


def quaternion_to_euler_zyx(q_xyzw: ArrayLike) -> Array:
    """Unit quaternions (..., 4) -> roll, pitch, yaw (..., 3), rad."""
    return matrix_to_euler_zyx(quaternion_to_matrix(q_xyzw))


def euler_zyx_to_quaternion(euler: ArrayLike) -> Array:
    """Roll, pitch, yaw (..., 3), rad -> unit quaternions (..., 4), qw >= 0."""
    roll, pitch, yaw = np.moveaxis(np.asarray(euler, dtype=np.float64), -1, 0)
    zero = np.zeros_like(roll)
    about_x = quaternion_exp(np.stack([roll, zero, zero], axis=-1))
    about_y = quaternion_exp(np.stack([zero, pitch, zero], axis=-1))
    about_z = quaternion_exp(np.stack([zero, zero, yaw], axis=-1))
    product = quaternion_multiply(quaternion_multiply(about_z, about_y), about_x)
    return quaternion_normalise(product)


def nearest_rotation(M: ArrayLike) -> Array:
    """Return the rotations nearest to M (..., 3, 3) in the Frobenius norm (polar, by SVD)."""
    u, _, vt = np.linalg.svd(np.asarray(M, dtype=np.float64))
    sign = np.ones((*u.shape[:-2], 3))
    sign[..., 2] = np.sign(np.linalg.det(u @ vt))
    return np.asarray(u * sign[..., None, :] @ vt)


def mean_rotation(q_xyzw: ArrayLike) -> Array:
    """Return the mean (4,) of unit quaternions (n, 4) in the chordal metric.

    The mean is the eigenvector of the largest eigenvalue of ``sum q q^T`` (Markley et al. 2007); it
    does not depend on the sign of each quaternion.
    """
    q: Array = np.asarray(q_xyzw, dtype=np.float64)
    _, vectors = np.linalg.eigh(q.T @ q)
    return quaternion_normalise(vectors[:, -1])
