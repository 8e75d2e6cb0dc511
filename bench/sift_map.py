"""A classical baseline: a map of SIFT points and a pose by matching, calibrated like the methods.

    python bench/sift_map.py DATASET SPLIT SEED [--json FILE]

The map is made from the frames that the methods train on (roles train and fit). A frame's keypoints
are matched with the map's descriptors; RANSAC with SQPnP (Terzakis and Lourakis 2020) finds the
pose, and the solver of SCR refines it on all matches and gives its covariance; a scale per frame,
from the errors of its matches, makes the intervals wider. Thresholds come from cal by both rules; a
frame without a pose gets the whole workspace.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from provenance import write_result

from cvo_edge import geometry
from cvo_edge.camera import Camera
from cvo_edge.conformal import capped_quantile, conformal_quantile, interval_score
from cvo_edge.errors import SourceError
from cvo_edge.pose import Chart
from cvo_edge.pose_solver import PoseSolver
from cvo_export.data.sparse_map import SparseMap, keypoints, sparse_map
from cvo_export.data.splits import make_split
from cvo_export.datasets import PoseDataset, open_dataset

Array = NDArray[np.float64]

CONFIDENCE = 0.9
CHART = Chart("tangent_predicted")
# A match is kept up to this ratio of distances; RANSAC's inliers, in pixels of a 640 wide image.
RATIO, INLIER_PX, LEAST_MATCHES = 0.9, 6.0, 8


class Located(NamedTuple):
    """Errors (n, 6) and deviations (n, 6) of frames; infinite where no pose was found.

    ``frame_ms`` is the median time from an image to its pose.
    """

    error: Array
    deviation: Array
    sequence: NDArray[np.int64]
    frame_ms: float


def locate(
    image: NDArray[np.uint8], camera: Camera, known: SparseMap, damping: Array
) -> tuple[Array, Array]:
    """Return the pose (7,) and deviation (6,) of a frame; infinite deviations without a pose."""
    found = keypoints(image, camera)
    lost = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]), np.full(6, np.inf)
    if len(found.rays) < LEAST_MATCHES:
        return lost
    likeness = found.descriptors @ known.descriptors.T
    best = likeness.argmax(axis=1)
    rows = np.arange(len(best))
    mutual = likeness.argmax(axis=0)[best] == rows
    nearest = likeness[rows, best]
    likeness[rows, best] = -1.0
    good = mutual & (1.0 - nearest < RATIO**2 * (1.0 - likeness.max(axis=1)))
    points, rays = known.points[best[good]], found.rays[good]
    if len(points) < LEAST_MATCHES:
        return lost
    pixel = camera.width / 640 / camera.focal_px
    cv2.setRNGSeed(0)
    solved, rotation, translation, inliers = cv2.solvePnPRansac(
        points,
        rays,
        np.eye(3),
        None,
        iterationsCount=1000,
        reprojectionError=INLIER_PX * pixel,
        flags=cv2.SOLVEPNP_SQPNP,
    )
    if not solved or inliers is None or len(inliers) < LEAST_MATCHES:
        return lost
    R = cv2.Rodrigues(rotation)[0].T
    start = np.concatenate([-R @ translation[:, 0], geometry.matrix_to_quaternion(R)])
    refined = PoseSolver(rays, start[np.newaxis], damping).solve(points, np.full(len(rays), pixel))
    return refined.pose, np.sqrt(np.diag(np.linalg.inv(refined.information)))


def located(
    dataset: PoseDataset,
    indices: NDArray[np.int64],
    camera: Camera,
    known: SparseMap,
    damping: Array,
) -> Located:
    """Locate frames of a data set."""
    found, spent = [], []
    for index in indices.tolist():
        image = dataset.read_image(index)
        begin = perf_counter()
        found.append(locate(image, camera, known, damping))
        spent.append(1e3 * (perf_counter() - begin))
    poses = np.array([pose for pose, _ in found])
    offset = CHART.coordinates(dataset.poses[indices], poses) - CHART.coordinates(poses, poses)
    deviation = np.array([deviation for _, deviation in found])
    return Located(offset, deviation, dataset.sequence[indices], float(np.median(spent)))


def figures(
    cal: Located, test: Located, unit: Array, workspace: Array, rule: str
) -> dict[str, Any]:
    """Coverage, width and score at 0.9 by one rule; ``workspace`` (6,) replaces infinite widths."""
    # Without a pose the set is everything: the truth is inside, at no threshold.
    scores = np.where(np.isfinite(cal.deviation), np.abs(cal.error) / cal.deviation, 0.0)
    if rule == "hierarchical":
        q_hat = [capped_quantile(s, cal.sequence, CONFIDENCE, 1.0) for s in scores.T]
    else:
        q_hat = [conformal_quantile(s, CONFIDENCE) for s in scores.T]
    half = np.minimum(np.array(q_hat) * test.deviation, 0.5 * workspace)
    half[~np.isfinite(half)] = np.broadcast_to(0.5 * workspace, half.shape)[~np.isfinite(half)]
    error = np.where(np.isfinite(test.deviation), np.abs(test.error), 0.0)
    score = interval_score(2.0 * half, np.maximum(error - half, 0.0), 1.0 - CONFIDENCE)
    return {
        "coverage": (error <= half).mean(axis=0).tolist(),
        "mean_width": (2.0 * half).mean(axis=0).tolist(),
        "median_width": np.median(2.0 * half, axis=0).tolist(),
        "normalised_interval_score": float((score / unit).mean()),
    }


def main() -> None:
    """Build the map, locate cal and test frames, print the figures; write JSON where asked."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("dataset")
    parser.add_argument("split", choices=("random", "block", "sequence"))
    parser.add_argument("seed", type=int)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    dataset = open_dataset(arguments.dataset)
    camera = dataset.camera()
    if camera is None:
        raise SourceError(f"{dataset.name}: expected intrinsics, found none")
    roles = make_split(dataset, arguments.split, arguments.seed).roles
    rows = np.concatenate([roles["train"], roles["fit"]])
    poses = dataset.poses[rows]
    known = sparse_map(
        lambda row: dataset.read_image(int(rows[row])),
        poses,
        camera,
        arguments.seed,
        lambda *_: None,
    )
    reference = geometry.mean_rotation(poses[:, 3:])
    coordinates = Chart("tangent_reference", reference).coordinates(poses, poses)
    unit = coordinates.std(axis=0)
    workspace = 2.0 * (coordinates.max(axis=0) - coordinates.min(axis=0))
    cal, test = (
        located(dataset, roles[role], camera, known, 3.0 * unit) for role in ("cal", "test")
    )
    with_pose = np.isfinite(test.deviation[:, 0])
    distance = np.linalg.norm(test.error[with_pose, :3], axis=1)
    turn = np.linalg.norm(test.error[with_pose, 3:], axis=1)
    report = {
        "dataset": dataset.name,
        "split": arguments.split,
        "seed": arguments.seed,
        "points": len(known.points),
        "lost": int((~with_pose).sum()),
        "frames": len(with_pose),
        "frame_ms": test.frame_ms,
        "point_error": {
            "median_m": float(np.median(distance)),
            "median_deg": float(np.rad2deg(np.median(turn))),
            "p90_m": float(np.quantile(distance, 0.9)),
            "p90_deg": float(np.rad2deg(np.quantile(turn, 0.9))),
            "p99_m": float(np.quantile(distance, 0.99)),
        },
        **{rule: figures(cal, test, unit, workspace, rule) for rule in ("pooled", "hierarchical")},
    }
    error = report["point_error"]
    print(
        f"{dataset.name}, {arguments.split}, seed {arguments.seed}: {report['points']} points, "
        f"{report['lost']} of {report['frames']} frames without a pose, {test.frame_ms:.0f} ms a "
        f"frame\n"
        f"  error {100 * error['median_m']:.2f} cm {error['median_deg']:.2f} deg, 90 % "
        f"{100 * error['p90_m']:.2f} cm {error['p90_deg']:.2f} deg, 99 % "
        f"{100 * error['p99_m']:.1f} cm"
    )
    for rule in ("pooled", "hierarchical"):
        found = report[rule]
        print(
            f"  {rule}: coverage {np.mean(found['coverage']):.3f}, width "
            f"{100 * np.mean(found['mean_width'][:3]):.2f} cm "
            f"{np.rad2deg(np.mean(found['mean_width'][3:])):.2f} deg (median "
            f"{100 * np.mean(found['median_width'][:3]):.2f} cm), score "
            f"{found['normalised_interval_score']:.3f}"
        )
    if arguments.json:
        write_result(arguments.json, report)


if __name__ == "__main__":
    main()
