"""What a bundle says of images it should not trust, and of cameras whose intrinsics are given.

    python bench/strangers.py BUNDLE DATASET [--place DATASET ...] [--json FILE]

Test frames of DATASET pass as they are, altered, through other cameras that nobody states, through
other cameras that are stated, and with wrong numbers stated; then come frames of other places, with
their own cameras stated. Each recording is one stream. An interval is wrong if its joint set at 0.9
misses the true pose; every interval of another place is, unless both have the same world.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from msgspec.structs import replace
from played import CONFIDENCE, Image, Rows, Seen, by_recording, spread
from provenance import write_result
from wrong_kinds import KINDS, Kind, frame

from cvo_edge.camera import Camera
from cvo_edge.engine.loading import Bundle, read_bundle
from cvo_edge.errors import UsageError
from cvo_edge.odometer import Odometer
from cvo_edge.record import Reason
from cvo_edge.vocabulary import Scope
from cvo_export.data.splits import same_split
from cvo_export.datasets import PoseDataset, open_dataset

Change = Callable[[Image], Image]

# Frames of another place, evenly spread over it.
FRAMES = 200


class Stream(NamedTuple):
    """All estimates of one kind of frames, and what the last recording says of the camera."""

    seen: list[Seen]
    focal: float | None

    def figures(self) -> dict[str, Any]:
        """Return shares of frames, and when and how another camera was noticed."""
        finite = [each for each in self.seen if each.estimate.bounded]
        wrong = sum(not each.estimate.contains(each.truth) for each in finite)
        # Of each recording; 0 where it is never noticed.
        noticed: dict[int, int] = {}
        for each in self.seen:
            found = Reason.CAMERA_DIFFERS in each.estimate.reasons
            noticed[each.recording] = noticed.get(each.recording) or (each.number if found else 0)
        late = [number or np.inf for number in noticed.values()]
        return {
            "frames": len(self.seen),
            "finite": len(finite) / len(self.seen),
            "wrong": wrong / len(self.seen),
            "noticed_after": [number or None for number in noticed.values()],
            "median_noticed_after": None if np.isinf(np.median(late)) else float(np.median(late)),
            "focal_factor": self.focal,
        }

    def accuracy(self) -> dict[str, Any]:
        """Return errors, coverage per degree of freedom, and width of the frames' intervals."""
        finite = [each for each in self.seen if each.estimate.bounded]
        if not finite:
            return {}
        errors = [
            np.linalg.norm(e.estimate.pose.t_m - e.truth[:3]) for e in finite if e.estimate.pose
        ]
        return {
            "median_m": float(np.median(errors)),
            "p90_m": float(np.quantile(errors, 0.9)),
            "coverage": float(np.mean([e.estimate.covers(e.truth) for e in finite])),
            "mean_width_m": float(np.mean([e.estimate.conformal_set.width()[:3] for e in finite])),
        }


def run(
    bundle: Bundle,
    dataset: PoseDataset,
    indices: Rows,
    change: Change,
    camera: Camera | None = None,
    scope: Scope = "joint",
) -> Stream:
    """Pass frames, recording by recording."""
    seen = []
    estimate = None
    with Odometer(bundle, confidence=CONFIDENCE, scope=scope, camera=camera) as odometer:
        for recording in by_recording(dataset, indices):
            rows = recording.tolist()
            images = (np.ascontiguousarray(change(dataset.read_image(row))) for row in rows)
            for number, (row, found) in enumerate(zip(rows, odometer.stream(images), strict=True)):
                place = int(dataset.sequence[row])
                seen.append(Seen(found, dataset.poses[row], place, number + 1))
            estimate = odometer.seen_camera or estimate
    return Stream(seen, estimate and float(np.sqrt(estimate.fx * estimate.fy)))


def alone(kind: Kind) -> Change:
    """Return a kind as a change of one image."""
    return lambda image: frame(kind, [image], 0)


# Name in the results -> the kind's.
ALTERED: dict[str, Change] = {
    name: alone(KINDS[kind])
    for name, kind in {
        "mirrored": "mirrored",
        "upside down": "upside down",
        "turned by 90 degrees": "turned by 90 degrees",
        "turned by 180 degrees": "turned by 180 degrees",
        "negative": "negative",
        "halves swapped": "halves swapped",
        "torn": "rows rolled",
    }.items()
}


def other_cameras(own: Camera) -> dict[str, Camera]:
    """Return cameras that are not what the bundle states."""
    lens = own.coefficients or (0.0, 0.0, 0.0, 0.0)

    def distorted(k1: float) -> Camera:
        coefficients = (lens[0] + k1, *lens[1:])
        return replace(own, distortion="radial_tangential", coefficients=coefficients)

    return {
        **{f"focal length x {zoom:g}": own.zoomed(zoom) for zoom in (0.8, 0.95, 1.05, 1.25)},
        "aspect x 1.05": replace(own, fx=1.05 * own.fx),
        "aspect x 1.33": replace(own, fx=4.0 / 3.0 * own.fx),
        "k1 - 0.1": distorted(-0.1),
        "k1 - 0.25": distorted(-0.25),
    }


def seen_by(other: Camera, own: Camera) -> Change:
    """Return the change of an image of ``own`` into what ``other`` would show from the same place.

    Beyond the image, its content is reflected.
    """
    y, x = np.mgrid[: other.height, : other.width].astype(np.float64)
    rays = other.rays(np.column_stack([x.ravel(), y.ravel()]))
    source = own.project(np.column_stack([rays, np.ones(len(rays))])).reshape(*x.shape, 2)
    places = np.nan_to_num(source, nan=-1.0).astype(np.float32)

    def change(image: Image) -> Image:
        found = cv2.remap(image, places, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101)
        return np.asarray(found, np.uint8)

    return change


def cropped(own: Camera, share: float, scale: float) -> tuple[Camera, Change]:
    """Return the camera of images cut to the middle of their sides and scaled, and the change."""
    height, width = round(share * own.height), round(share * own.width)
    top, left = (own.height - height) // 2, (own.width - width) // 2
    size = round(scale * width), round(scale * height)
    camera = own.cropped(top, top + height, left, left + width).scaled(*size)

    def change(image: Image) -> Image:
        part = image[top : top + height, left : left + width]
        return np.asarray(cv2.resize(part, size, interpolation=cv2.INTER_AREA), np.uint8)

    return camera, change


# Share of the sides, and scale of what is left; the first changes nothing.
STATED = {
    "as it is": (1.0, 1.0),
    "half the resolution": (1.0, 0.5),
    "cut to 0.9": (0.9, 1.0),
    "cut to 0.8, scaled by 1.25": (0.8, 1.25),
    "cut to 0.7, scaled by 0.75": (0.7, 0.75),
}


def misstated(own: Camera) -> dict[str, Camera]:
    """Return cameras that somebody states by mistake for images of ``own``."""
    return {
        "focal length x 1.01": replace(own, fx=1.01 * own.fx, fy=1.01 * own.fy),
        "focal length x 1.025": replace(own, fx=1.025 * own.fx, fy=1.025 * own.fy),
        "focal length x 1.05": replace(own, fx=1.05 * own.fx, fy=1.05 * own.fy),
        "principal point 1 % of the width aside": replace(own, cx=own.cx + 0.01 * own.width),
        "principal point 3 % of the width aside": replace(own, cx=own.cx + 0.03 * own.width),
    }


def line(name: str, found: dict[str, Any]) -> str:
    """Return one row of the printed table."""
    text = f"  {name:<30} {found['frames']:>4} frames, finite {found['finite']:.3f}, wrong "
    text += f"{found['wrong']:.3f}"
    noticed = [number for number in found["noticed_after"] if number]
    if noticed:
        text += (
            f", camera_differs in {len(noticed)} of {len(found['noticed_after'])} recordings, from "
            f"frame {np.median(noticed):g} (median; {min(noticed)} to {max(noticed)})"
        )
    if found["focal_factor"] is not None:
        text += f", focal length x {found['focal_factor']:.3f}"
    if "coverage" in found:
        text += (
            f"; error {100 * found['median_m']:.2f} cm, 90 % {100 * found['p90_m']:.2f} cm, "
            f"coverage {found['coverage']:.3f} per DoF, {found['joint_coverage']:.3f} joint, width "
            f"{100 * found['mean_width_m']:.2f} cm"
        )
    return text


def main() -> None:
    """Print a row for each kind; write all of them as JSON where asked."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("bundle", type=Path)
    parser.add_argument("dataset")
    parser.add_argument("--place", action="append", default=[], help="data set of another place")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    bundle = read_bundle(arguments.bundle)
    dataset = open_dataset(arguments.dataset)
    own = bundle.calibration.camera
    if own is None or not bundle.head.solves:
        raise UsageError(f"{arguments.bundle}: expected a bundle that knows its camera")
    test = same_split(dataset, bundle.calibration.calibration.split).roles["test"]
    report: dict[str, dict[str, Any]] = {}

    def add(kind: str, name: str, found: dict[str, Any]) -> None:
        report.setdefault(kind, {})[name] = found
        print(line(name, found), flush=True)

    print("altered images")
    for name, change in ALTERED.items():
        add("altered", name, run(bundle, dataset, test, change).figures())
    print("other cameras, not stated")
    for name, other in other_cameras(own).items():
        add("not_stated", name, run(bundle, dataset, test, seen_by(other, own)).figures())
    print("other cameras, stated")
    for name, (share, scale) in STATED.items():
        camera, change = cropped(own, share, scale)
        jointly = run(bundle, dataset, test, change, camera)
        each = run(bundle, dataset, test, change, camera, "marginal")
        figures, accuracy = jointly.figures(), each.accuracy()
        if figures["finite"]:
            accuracy["joint_coverage"] = 1.0 - figures["wrong"] / figures["finite"]
        add("stated", name, {**figures, **accuracy})
    print("the bundle's camera, other numbers stated")
    for name, camera in misstated(own).items():
        add("misstated", name, run(bundle, dataset, test, lambda image: image, camera).figures())
    print("other places, their cameras stated")
    for text in arguments.place:
        place = open_dataset(text)
        rows = spread(np.arange(len(place)), FRAMES)
        found = run(bundle, place, rows, lambda image: image, place.camera())
        add("places", place.name, found.figures())
    if arguments.json:
        write_result(arguments.json, {"bundle": bundle.calibration.name, **report})


if __name__ == "__main__":
    main()
