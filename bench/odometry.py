"""The front end on recordings with true poses: errors, coverage of its intervals, and time.

    python bench/odometry.py [--sets kitti_00 euroc_mh05 redkitchen kitchen_flights room]

Real recordings come from ``CVO_DATA``; the room is rendered. Results:
``results/odometry/SET.json``.

Errors are those of every step: the angle between estimated and true rotation, and, of steps that
have a direction and whose truth moves a millimetre or more, the angle between the directions.
``by_parallax`` has the median error of direction by the parallax of the step, without the limit.
``variants``: the same steps with another kind of corners, first solution or refinement.
``intervals``: coverage at 0.9 of recordings that were not calibrated on. Sets of several recordings
are split by recording; of a single one, the first half calibrates, in four blocks that count as
drives, and the second half is tested, which is closer to it than another recording would be.
Coverage counts all motions; ``withheld`` is the share that ``annotate`` would leave out as faster
or rougher than calibrated ones.
``ms`` is processor time of one thread for each frame, without reading it: the median.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from provenance import RESULTS, write_result

from cvo_edge import geometry
from cvo_edge.errors import SourceError
from cvo_edge.frontend import essential
from cvo_edge.frontend import odometry as front
from cvo_edge.frontend.odometry import FrontEnd
from cvo_edge.frontend.records import COLUMNS, columns_of
from cvo_edge.frontend.refine import Refined, sampson
from cvo_edge.frontend.steps import Step
from cvo_edge.motion.audit import audit
from cvo_edge.motion.conformalize import conformalize
from cvo_edge.motion.direction import LEAST_M
from cvo_edge.motion.horizons import Horizon
from cvo_edge.motion.intervals import Level, MotionCalibration
from cvo_edge.motion.pairs import Pair
from cvo_edge.motion.relative import motion
from cvo_edge.spread import Here
from cvo_edge.trajectories.interpolation import Track
from cvo_export.datasets import PoseDataset, open_dataset

Array = NDArray[np.float64]

DATA = Path(os.environ.get("CVO_DATA", "data"))
# Data set, frames per second, and how many recordings calibrate; 0: half of a single one.
SETS: dict[str, tuple[str, float, int]] = {
    "kitti_00": (f"kitti:{DATA / 'kitti_00'}", 10.0, 0),
    "euroc_mh05": (f"euroc:{DATA / 'euroc_mh05'}", 20.0, 0),
    "redkitchen": (f"7scenes:{DATA / 'redkitchen'}", 30.0, 0),
    "kitchen_flights": (f"7scenes:{DATA / 'kitchen_flights'}", 30.0, 36),
    "room": ("synthetic:room,flights=24,frames=50", 30.0, 16),
}
BLOCKS = 4
# Recordings of a set that variants are tried on, and frames of each.
TRIED, TRIED_FRAMES = 4, 300
PARALLAX_PX = (0.0, 0.15, 0.3, 0.5, 0.7, 1.0, 2.0, 5.0)
LEVEL = 0.9
_CELL = 20
# As in cvo_edge/frontend/essential.py.
_SOUGHT_PX = 0.25
# What the scale of intervals may use: nothing, the motion, and columns of the front end, too.
SCALES: dict[str, tuple[bool, tuple[str, ...]]] = {
    "none": (False, ()),
    "auto": (True, ()),
    "columns": (True, COLUMNS),
}


class Followed(NamedTuple):
    """The steps of one recording, the true poses (n, 7), and milliseconds of each step (n,)."""

    name: str
    steps: list[Step]
    truth: Array
    ms: list[float]


def follow(data: PoseDataset, sequence: int, most: int | None = None) -> Followed:
    """Run the front end on the first frames of one recording."""
    camera = data.camera()
    if camera is None:
        raise SourceError(f"{data.name}: expected the camera, found none")
    frames = np.flatnonzero(data.sequence == sequence)[:most]
    end, steps, times = FrontEnd(camera), [], []
    for frame in frames.tolist():
        image = data.read_image(frame)
        start = time.process_time()
        steps.append(end.step(image))
        times.append(1e3 * (time.process_time() - start))
    return Followed(data.sequence_names[sequence], steps, data.poses[frames], times[1:])


def errors(followed: Sequence[Followed]) -> dict[str, Any]:
    """Return the figures of all steps of some recordings."""
    turns, angles, parallaxes, lost, steps = [], [], [], 0, 0
    for each in followed:
        true = motion(each.truth[:-1], each.truth[1:])
        for step, (*t, a, b, c, d) in zip(each.steps[1:], true.tolist(), strict=True):
            steps += 1
            if step.motion is None:
                lost += 1
                continue
            q = geometry.matrix_to_quaternion(step.motion.R)
            turned = geometry.quaternion_multiply(geometry.quaternion_conjugate(q), [a, b, c, d])
            turns.append(np.linalg.norm(geometry.quaternion_log(turned)))
            parallaxes.append(step.motion.parallax_px)
            angle = np.nan
            if step.motion.direction is not None and np.linalg.norm(t) >= LEAST_M:
                cosine = step.motion.direction @ t / np.linalg.norm(t)
                angle = float(np.arccos(np.clip(cosine, -1.0, 1.0)))
            angles.append(angle)
    # A lost step is worse than any other.
    rotation = np.rad2deg([*turns, *[np.pi] * lost])
    direction = np.rad2deg(angles)
    known = direction[np.isfinite(direction)]
    null = sum(
        step.motion is None or step.motion.direction is None
        for each in followed
        for step in each.steps[1:]
    )
    return {
        "steps": steps,
        "lost": lost,
        "null_directions": null / steps,
        "rotation_deg": np.quantile(rotation, [0.5, 0.9]).tolist(),
        "direction_deg": np.quantile(known, [0.5, 0.9]).tolist() if len(known) else None,
        "by_parallax": [
            {
                "from_px": low,
                "steps": int(inside.sum()),
                "direction_deg": float(np.median(direction[inside])),
            }
            for low, high in zip(PARALLAX_PX, (*PARALLAX_PX[1:], np.inf), strict=True)
            for px in [np.array(parallaxes)]
            for inside in [(px >= low) & (px < high) & np.isfinite(direction)]
            if inside.any()
        ],
    }


def fast_corners(image: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return the strongest FAST corner of each cell."""
    found = cv2.FastFeatureDetector_create(10).detect(image)
    if not found:
        return np.empty((0, 2), np.float32)
    points = cv2.KeyPoint_convert(found)
    strength = np.array([each.response for each in found])
    side = np.sqrt(image.size / _CELL**2)
    cell = (points[:, 1] // side) * 1e4 + points[:, 0] // side
    order = np.lexsort((-strength, cell))
    first = np.diff(cell[order], prepend=-1.0) > 0
    return np.asarray(points[order[first]], np.float32)


def recovered(x1: Array, x2: Array, _: Array, focal_px: float) -> tuple[Array, Array] | None:
    """Return OpenCV's choice among the four solutions."""
    a, b = (np.ascontiguousarray(x[:2].T) for x in (x2, x1))
    E, _ = cv2.findEssentialMat(a, b, np.eye(3), cv2.RANSAC, 0.999, _SOUGHT_PX / focal_px, 100)
    if E is None or len(E) < 3:
        return None
    _, found, t, _ = cv2.recoverPose(E[:3], a, b, np.eye(3))
    return found, t.ravel()


def sampled(method: int, threshold_px: float) -> Callable[..., tuple[Array, Array] | None]:
    """Return another search for a first solution."""

    def five_points(x1: Array, x2: Array, R: Array, focal_px: float) -> tuple[Array, Array] | None:
        a, b = (np.ascontiguousarray(x[:2].T) for x in (x2, x1))
        E, _ = cv2.findEssentialMat(a, b, np.eye(3), method, 0.999, threshold_px / focal_px, 100)
        if E is None or len(E) < 3 or not np.isfinite(E[:3]).all():
            return None
        first, second, t = cv2.decomposeEssentialMat(E[:3])
        return max((first, second), key=lambda each: float(np.sum(each * R))), t.ravel()

    return five_points


def unrefined(x1: Array, x2: Array, R: Array, t: Array, least: float) -> Refined:
    """Return a first solution as it is."""
    return Refined(R, t, sampson(x1, x2, R, t), 3.0 * least, np.eye(5))


VARIANTS: dict[str, list[tuple[Any, str, Any]]] = {
    "FAST in cells": [(front, "corners", fast_corners)],
    "RANSAC at 1 px": [(essential, "_five_points", sampled(cv2.RANSAC, 1.0))],
    "LMEDS": [(essential, "_five_points", sampled(cv2.LMEDS, _SOUGHT_PX))],
    "USAC_MAGSAC": [(essential, "_five_points", sampled(cv2.USAC_MAGSAC, _SOUGHT_PX))],
    "recoverPose": [(essential, "_five_points", recovered)],
    "not refined": [(essential, "refine_motion", unrefined)],
    "one motion of a plane": [(essential, "_of_plane", lambda *_: [])],
    "no limit of parallax": [(essential, "LEAST_PARALLAX_PX", 0.0)],
}


@contextmanager
def replaced(places: Sequence[tuple[Any, str, Any]]) -> Iterator[None]:
    """Replace parts of modules for a while."""
    before = [(module, name, getattr(module, name)) for module, name, _ in places]
    for module, name, value in places:
        setattr(module, name, value)
    try:
        yield
    finally:
        for module, name, value in before:
            setattr(module, name, value)


def pair_of(each: Followed, fps: float, part: slice, group: str) -> Pair:
    """Return some steps of a recording with their truth."""
    steps = each.steps[part]
    stamps = np.rint(1e9 / fps * np.arange(len(steps))).astype(np.int64)
    table = [columns_of(step) for step in steps]
    columns = {name: np.array([row[name] for row in table]) for name in COLUMNS}
    estimate = np.array([step.pose for step in steps])
    name = f"{each.name}-{group}"
    return Pair(
        name, group, stamps, estimate, columns, Track(stamps, each.truth[part]), unscaled=True
    )


def intervals(followed: Sequence[Followed], fps: float, calibrating: int) -> list[dict[str, Any]]:
    """Return coverage and widths on recordings that were not calibrated on."""
    if calibrating:
        pairs = [pair_of(each, fps, slice(None), each.name) for each in followed]
        known, new = pairs[:calibrating], pairs[calibrating:]
    else:
        (one,) = followed
        half = len(one.steps) // 2
        edges = np.linspace(0, half, BLOCKS + 1).astype(int).tolist()
        known = [pair_of(one, fps, slice(a, b), f"block-{a}") for a, b in pairwise(edges)]
        new = [pair_of(one, fps, slice(half, None), "second half")]
    found = []
    for name, (learned, columns) in SCALES.items():
        file = conformalize(
            Here(known), "bench", [Horizon.parse("1f")], learned=learned, columns=columns
        )
        calibration = MotionCalibration(file)
        withheld = [each.withheld for each in audit(calibration, Level(LEVEL), new).recordings]
        calibration.familiar = calibration.familiar._replace(limit=np.inf)
        report = audit(calibration, Level(LEVEL), new)
        rows = report.over("1f")
        pointed = [row for row in rows if row.directions]
        found.append(
            {
                "scale": name,
                "recordings": len(rows),
                "withheld": float(np.mean(withheld)),
                "dof": float(np.mean([row.dof for row in rows])),
                "rotation": float(np.mean([row.rotation for row in rows])),
                "direction": float(np.mean([row.position for row in pointed])),
                "rotation_deg": float(np.rad2deg(np.mean([row.radii[1] for row in rows]))),
                "direction_deg": float(np.rad2deg(np.mean([row.radii[0] for row in pointed]))),
            }
        )
    return found


def few(data: PoseDataset, sequences: Sequence[int]) -> dict[str, Any]:
    """Return the figures of the first frames of some recordings."""
    return errors([follow(data, sequence, TRIED_FRAMES) for sequence in sequences])


def main() -> None:
    """Measure the sets and write a result for each."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--sets", nargs="+", default=list(SETS), choices=list(SETS))
    cv2.setNumThreads(1)
    for name in parser.parse_args().sets:
        spec, fps, calibrating = SETS[name]
        data = open_dataset(spec)
        every = range(len(data.sequence_names))
        followed = [follow(data, sequence) for sequence in every]
        tried = list(every)[-TRIED:]
        with replaced(VARIANTS["no limit of parallax"]):
            unlimited = few(data, tried)
        figures = errors(followed) | {"by_parallax": unlimited["by_parallax"]}
        variants = {
            "as it is": errors([follow(data, sequence, TRIED_FRAMES) for sequence in tried])
        }
        for variant, places in VARIANTS.items():
            with replaced(places):
                variants[variant] = errors(
                    [follow(data, sequence, TRIED_FRAMES) for sequence in tried]
                )
        for each in variants.values():
            del each["by_parallax"]
        content = {
            "set": name,
            "recordings": len(followed),
            "size": list(data.read_image(0).shape[1::-1]),
            **figures,
            "ms": float(np.median([ms for each in followed for ms in each.ms])),
            "variants": variants,
            "intervals": intervals(followed, fps, calibrating),
        }
        write_result(RESULTS / "odometry" / f"{name}.json", content)


if __name__ == "__main__":
    main()
