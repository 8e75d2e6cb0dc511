"""Simulated drives, and an estimator whose errors are known."""

import numpy as np
from numpy.typing import NDArray

from cvo_edge import geometry
from cvo_edge.motion.pairs import Pair
from cvo_edge.motion.relative import rotated
from cvo_edge.trajectories.interpolation import Track

Array = NDArray[np.float64]

PERIOD_NS = 50_000_000


def composed(first: Array, second: Array) -> Array:
    """Poses (..., 7) and motions (..., 7) -> the poses after the motions."""
    t = first[..., :3] + rotated(first[..., 3:], second[..., :3])
    q = geometry.quaternion_multiply(first[..., 3:], second[..., 3:])
    return np.concatenate([t, geometry.quaternion_normalise(q)], axis=-1)


def twist(numbers: Array) -> Array:
    """Six numbers (..., 6), m and rad -> motions (..., 7)."""
    q = geometry.quaternion_exp(numbers[..., 3:])
    return np.concatenate([numbers[..., :3], q], axis=-1)


def chained(steps: Array) -> Array:
    """Motions (n, 7) -> poses (n + 1, 7) from the identity on."""
    poses = [np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])]
    for step in steps:
        poses.append(composed(poses[-1], step))
    return np.array(poses)


def smooth(generator: np.random.Generator, count: int) -> Array:
    """Return steps (count, 6) of a body that speeds up, slows down and turns about all axes."""
    time = np.arange(count) * 1e-9 * PERIOD_NS
    waves = generator.uniform(0.05, 0.6, (6, 3)) * time[:, np.newaxis, np.newaxis]
    phase = generator.uniform(0.0, 2.0 * np.pi, (6, 3))
    speeds = np.sin(2.0 * np.pi * waves + phase).sum(axis=2)
    speeds *= np.array([0.5, 0.3, 0.3, 0.3, 0.3, 0.5])
    speeds[:, 0] += 1.0
    return 1e-9 * PERIOD_NS * speeds


def drive(
    seed: int, count: int = 400, noise: float = 1.0, bias: Array | None = None, name: str = ""
) -> Pair:
    """Return a drive; each step's errors are normal, of 2 mm and 1 mrad times ``noise``.

    ``bias`` (6, 6): errors that are linear in the motion.
    """
    generator = np.random.default_rng(seed)
    steps = smooth(generator, count)
    truth = chained(twist(steps))
    off = noise * generator.normal(size=(count, 6)) * np.repeat([0.002, 0.001], 3)
    if bias is not None:
        off += steps @ bias
    # dE^-1 dG = Exp(x) for each step.
    inverse = twist(np.concatenate([-off[:, :3], -off[:, 3:]], axis=1))
    estimate = chained(composed(twist(steps), inverse))
    stamps = PERIOD_NS * np.arange(count + 1)
    label = name or f"drive-{seed}"
    return Pair(label, label, stamps, estimate, {}, Track(stamps, truth))
