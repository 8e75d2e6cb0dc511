"""Covariances against sampled errors, and NEES of poses and motions.

    python bench/covariances.py

Sampled: frames of the demonstration clip by the bundle of each method, in both scopes; the set of
each frame is put around the pose in each rotation chart. Truths are drawn as the convention of
``cvo_edge.covariance`` has it, and seen from a base on a lever arm, in a map; ``error`` is the
largest difference between an entry of the covariance and the samples' second moment, over the
deviations of its row and column. Samples have the exact moments in the chart, so that no noise of
sampling is in it: what is left is that formulas are to first order, which shows in a second run
with sets of a tenth of the size. Motions: the same for what
``annotate --covariance`` gives of KITTI's drives (``CVO_DATA/trajectories``); for ``integrated``,
errors of single steps are drawn and composed.

NEES of poses: every fourth test frame of the room's flights, errors about the world's axes; before
(the first release): half-widths over the normal quantile of one degree of freedom, on the diagonal
in the chart, read as a filter reads them. NEES of motions: one drive of both public sets left out
at a time. Results: ``results/covariances``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from statistics import NormalDist
from typing import Any

import numpy as np
from motion import SETS, Pair
from networks import ARTIFACTS, DEMONSTRATED, demonstration
from numpy.typing import NDArray
from provenance import RESULTS, write_result

from cvo_edge import geometry
from cvo_edge.covariance import chi_square_quantile, nees
from cvo_edge.engine.loading import Bundle, read_bundle
from cvo_edge.estimate import PoseInterval
from cvo_edge.input.sources import open_source
from cvo_edge.motion.audit import audit
from cvo_edge.motion.conformalize import conformalize
from cvo_edge.motion.covariance import adjoint, in_fixed_axes
from cvo_edge.motion.intervals import Level, MotionCalibration
from cvo_edge.motion.recordings import trace_of
from cvo_edge.motion.relative import residual
from cvo_edge.odometer import Odometer
from cvo_edge.pose import Chart, Pose
from cvo_edge.programs.trajectories import correct_pairs, fits
from cvo_edge.record import Status
from cvo_edge.sets import ConformalSet, Ellipsoids
from cvo_edge.spread import Here
from cvo_edge.vocabulary import SCOPES, Scope
from cvo_export.bundles.observed import observe
from cvo_export.datasets import PoseDataset, open_dataset
from cvo_export.evaluate import subset_indices

Array = NDArray[np.float64]

ROOM = "synthetic:room,flights=100"
CLIP = str(ARTIFACTS / "synthetic-room-clip")
LEVEL, FRAMES, SAMPLES, EVERY = 0.9, 6, 40_000, 4
SHARES = (1.0, 0.1)
BASE = Pose(np.array([0.3, -0.2, 0.6]), geometry.quaternion_exp([0.2, 1.1, -0.4]))
MAP = Pose(np.array([10.0, -4.0, 2.0]), geometry.quaternion_exp([0.1, 0.2, 2.0]))
CHARTS = {
    "tangent_predicted": Chart("tangent_predicted"),
    "tangent_reference": Chart("tangent_reference", geometry.quaternion_exp([-0.4, 0.3, 0.2])),
    "euler_zyx": Chart("euler_zyx"),
}
# Steps that are added up: one second, and ten, of a LiDAR.
STEPS = (10, 97)


def main() -> None:
    """Measure and write."""
    generator = np.random.default_rng(0)
    dataset = open_dataset(ROOM)
    for method in DEMONSTRATED:
        bundle = read_bundle(demonstration(method))
        rows = [
            {**found, "error": pose_errors(bundle, found["scope"], generator)}
            for found in pose_nees(bundle, dataset)
        ]
        write_result(RESULTS / "covariances" / f"{method}.json", {"method": method, "rows": rows})
    for name, (read, wanted) in SETS.items():
        plain = Here(read())
        pairs = correct_pairs(plain, fits(plain), wanted)[0].collect()
        result: dict[str, Any] = {"set": name, "nees": motion_nees(pairs)}
        if name == "kitti_lidar":
            result["error"] = motion_errors(pairs, generator)
        write_result(RESULTS / "covariances" / f"{name}.json", result)


def pose_errors(
    bundle: Bundle, scope: Scope, generator: np.random.Generator
) -> dict[str, list[float]]:
    """Return the largest error of covariances by chart: of the sets, and of a tenth of them."""
    worst = {name: [0.0] * len(SHARES) for name in CHARTS}
    with Odometer(bundle, confidence=LEVEL, scope=scope, threads=1) as odometer:
        images = list(open_source(CLIP))[:: 50 // FRAMES]
        frames = [estimate for estimate in odometer.stream(images) if estimate.bounded]
    for estimate in frames:
        for name, chart in CHARTS.items():
            for place, share in enumerate(SHARES):
                error = sampled_error(in_chart(estimate, chart, share), generator)
                worst[name][place] = max(worst[name][place], error)
    return worst


def in_chart(estimate: PoseInterval, chart: Chart, share: float) -> PoseInterval:
    """Put the set of an estimate around its pose in another chart, a share of its size."""
    pose, found = estimate.pose.to_array(), estimate.conformal_set
    point, before = chart.point(pose), estimate.chart.point(pose)
    region = found.ellipsoids
    if region is not None:
        centres = point + share * (region.centres - before)
        region = Ellipsoids(centres, share * region.scale, region.radius)
    lower, upper = (point + share * (each - before) for each in (found.lower, found.upper))
    return replace(
        estimate, chart=chart, conformal_set=ConformalSet(lower, upper, ellipsoids=region)
    )


def sampled_error(estimate: PoseInterval, generator: np.random.Generator) -> float:
    """Compare a covariance with the second moment of drawn truths."""
    drawn = truths(estimate, generator)
    turns = quaternions(estimate.chart, estimate.pose, drawn[:, 3:])
    true = np.concatenate([drawn[:, :3], turns], axis=1)
    true = composed(MAP.to_array(), composed(true, BASE.to_array()))
    at = estimate.pose_of(BASE, MAP).to_array()
    return largest(estimate.covariance(T_camera_base=BASE, T_map_world=MAP), errors(true, at))


def truths(estimate: PoseInterval, generator: np.random.Generator) -> Array:
    """Draw truths in the chart (n, 6), as the convention has it."""
    found = estimate.conformal_set
    if found.ellipsoids is not None:
        region = found.ellipsoids
        scale = region.radius / np.sqrt(chi_square_quantile(LEVEL)) * region.scale
        each = max(2000, SAMPLES // len(region.centres))
        return np.concatenate([c + exact(each, generator) @ scale.T for c in region.centres])
    one = LEVEL ** (1 / 6) if estimate.scope == "joint" else LEVEL
    deviation = 0.5 * (found.upper - found.lower) / NormalDist().inv_cdf(0.5 + 0.5 * one)
    return 0.5 * (found.upper + found.lower) + exact(SAMPLES, generator) * deviation


def exact(count: int, generator: np.random.Generator, columns: int = 6) -> Array:
    """Draw normal numbers whose sample mean is zero and second moment the identity."""
    drawn = generator.normal(size=(count, columns))
    drawn -= drawn.mean(axis=0)
    root = np.linalg.cholesky(drawn.T @ drawn / count)
    return np.linalg.solve(root, drawn.T).T


def quaternions(chart: Chart, pose: Pose, numbers: Array) -> Array:
    """Return quaternions (n, 4) of rotation numbers (n, 3)."""
    if chart.rotation == "euler_zyx":
        return geometry.euler_zyx_to_quaternion(numbers)
    base = pose.q_xyzw if chart.reference_q_xyzw is None else chart.reference_q_xyzw
    return geometry.quaternion_multiply(base, geometry.quaternion_exp(numbers))


def composed(first: Array, second: Array) -> Array:
    """Return first * second of poses (..., 7)."""
    R = geometry.quaternion_to_matrix(first[..., 3:])
    t = first[..., :3] + (R @ second[..., :3, np.newaxis])[..., 0]
    q = geometry.quaternion_multiply(first[..., 3:], second[..., 3:])
    return np.concatenate([t, q], axis=-1)


def errors(true: Array, at: Array) -> Array:
    """Return x y z, then rotations about the fixed axes (n, 6)."""
    turn = geometry.quaternion_multiply(true[..., 3:], geometry.quaternion_conjugate(at[..., 3:]))
    return np.concatenate([true[..., :3] - at[..., :3], geometry.quaternion_log(turn)], axis=-1)


def largest(covariance: Array, sampled: Array) -> float:
    """Return the largest difference from the samples' second moment, over deviations."""
    moment = sampled.T @ sampled / len(sampled)
    scale = np.sqrt(np.diag(moment))
    return float(np.abs((covariance - moment) / np.outer(scale, scale)).max())


def pose_nees(bundle: Bundle, dataset: PoseDataset) -> list[dict[str, Any]]:
    """Return NEES / 6 and the share inside 0.9, of the first release's form and of this one."""
    calibration = bundle.calibration
    camera = dataset.camera() if bundle.head.solves else None
    with Odometer(bundle, confidence=LEVEL, threads=1, camera=camera) as odometer:
        seen = observe(odometer, dataset, subset_indices(calibration, dataset, "test")[::EVERY])
        chart, head = odometer.chart, odometer.head
    off, one = errors(seen.true_pose, seen.pose), NormalDist().inv_cdf(0.5 + 0.5 * LEVEL)
    rows = []
    for scope in SCOPES:
        before, now = [], []
        sets = seen.sets(head, calibration.threshold(LEVEL, scope))
        for at, found in zip(seen.pose, sets, strict=True):
            pose = Pose.from_array(at)
            estimate = PoseInterval(0, None, "", Status.OK, (), pose, found, LEVEL, scope, chart)
            before.append(np.diag((0.5 * (found.upper - found.lower) / one) ** 2))
            now.append(estimate.covariance())
        rows.append(
            {"scope": scope, "frames": len(off), "before": fit(off, before), "now": fit(off, now)}
        )
    return rows


def fit(off: Array, covariances: Sequence[Array]) -> dict[str, float]:
    """Return the mean of NEES / 6 and the share inside 0.9, of frames with a bounded set."""
    every = np.array(covariances)
    known = np.isfinite(every).all(axis=(1, 2))
    found = nees(off[known], every[known])
    inside = float(np.mean(found <= chi_square_quantile(LEVEL)))
    return {"nees": float(found.mean() / 6.0), "inside": inside}


def motion_nees(pairs: Sequence[Pair]) -> list[dict[str, Any]]:
    """Return mean and median over recordings of NEES over six, and the mean share inside."""
    rows: dict[tuple[str, str], list[Any]] = {}
    for drive in sorted({pair.group for pair in pairs}):
        others = [pair for pair in pairs if pair.group != drive]
        calibration = MotionCalibration(conformalize(Here(others), "bench"))
        own = [pair for pair in pairs if pair.group == drive]
        for one in audit(calibration, Level(LEVEL), own).recordings:
            for each in one.horizons:
                if each.motions:
                    rows.setdefault(("interval", each.horizon), []).append(each)
            for span in one.integrated:
                rows.setdefault(("integrated", f"{span.seconds:g}s"), []).append(span)
    return [
        {
            "covariance": kind,
            "over": over,
            "nees": float(np.mean([each.nees for each in found])),
            "nees_median": float(np.median([each.nees for each in found])),
            "inside": float(np.mean([each.nees_inside for each in found])),
        }
        for (kind, over), found in rows.items()
    ]


def motion_errors(pairs: Sequence[Pair], generator: np.random.Generator) -> dict[str, float]:
    """Return the largest error of the covariances of motions by horizon, and of sums of steps."""
    calibration = MotionCalibration(conformalize(Here(pairs[1:]), "bench"))
    rows = trace_of(pairs[0], calibration.limits, calibration.file.columns)
    worst: dict[str, float] = {}
    for horizon in calibration.horizons:
        found = horizon.intervals(rows, Level(LEVEL))
        some = generator.choice(len(found.end), FRAMES, replace=False)
        about_bias = horizon.shape.covariance(found.scale[some], np.zeros((FRAMES, 6)))
        own = horizon.shape.covariance(found.scale[some], found.bias[some])
        given = in_fixed_axes(own, found.moved[some, 3:])
        for place, row in enumerate(some):
            root = np.linalg.cholesky(about_bias[place])
            x = found.bias[row] + exact(SAMPLES, generator) @ root.T
            true = composed(found.moved[row], twists(x))
            error = largest(given[place], errors(true, found.moved[row]))
            name = f"interval {horizon.spec.horizon}"
            worst[name] = max(worst.get(name, 0.0), error)
    first = calibration.horizons[calibration.steps].intervals(rows, Level(LEVEL))
    steps = calibration.step_covariances(first.scale[:, :6])
    for count in STEPS:
        begin = int(generator.integers(0, len(first.end) - count))
        total, sampled = np.zeros((6, 6)), np.tile([0.0, 0, 0, 0, 0, 0, 1], (SAMPLES // 2, 1))
        plain, drawn = sampled[0], exact(len(sampled), generator, 6 * count)
        for place in range(begin, begin + count):
            step = first.moved[place]
            carried = adjoint(step[np.newaxis])[0]
            total = carried @ total @ carried.T + steps[place]
            own = drawn[:, 6 * (place - begin) : 6 * (place - begin + 1)]
            x = own * np.sqrt(np.diag(steps[place]))
            sampled, plain = composed(composed(sampled, step), twists(x)), composed(plain, step)
        off = residual(np.tile(plain, (len(sampled), 1)), sampled)
        worst[f"integrated {count} steps"] = largest(total, off)
    return worst


def twists(x: Array) -> Array:
    """Return motions (n, 7) of (t, Log R) (n, 6)."""
    return np.concatenate([x[:, :3], geometry.quaternion_exp(x[:, 3:])], axis=1)


if __name__ == "__main__":
    main()
