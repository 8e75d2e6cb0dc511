"""Alarms of the checks that compare a frame with earlier ones, and what they miss.

    CVO_DATA=... python bench/temporal.py

Counts the frames that ``frame_repeated`` and ``picture_still`` flag in every real recording of
``$CVO_DATA``, in streams of a camera that rests, creeps or returns, and in streams that are frozen,
partly frozen or played in a loop. No network is needed: only the preprocessing and the checks run.
H.264 is encoded with PyAV (``pip install av``), which the project itself does not need.
"""

from __future__ import annotations

import argparse
import io
import os
import timeit
from collections.abc import Callable, Iterable, Iterator
from itertools import islice, pairwise
from pathlib import Path
from time import process_time
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from provenance import RESULTS, ROOT, write_result

from cvo_edge.input.frame_checks import Look, StreamChecks, image_doubt
from cvo_edge.input.preprocess import model_input
from cvo_edge.input.sources import open_source
from cvo_edge.record import Reason

Image = NDArray[np.uint8]
Images = list[Image]

SIZE = 192, 256
CLIP = ROOT / "calibration_artifacts" / "synthetic-room-clip"
RECORDINGS = {
    "redkitchen": "redkitchen/seq-01",
    "kitchen_flights": "kitchen_flights/seq-*",
    "euroc_mh05": "euroc_mh05/mav0/cam0/data",
    "kitti_00": "kitti_00/sequences/00/image_*",
}
# Frames of a simulated stream, and of a recording that one is made of.
FRAMES, LONGEST = 100, 150
# Height and width of simulated cameras.
CAMERA = 240, 320
# Standard deviation of the noise of simulated cameras, in grey levels of the camera's image.
NOISES = 1.0, 2.0, 4.0


class Count:
    """Frames, and how many of them each reason flags; ``first`` is the first flagged frame."""

    def __init__(self) -> None:
        self.frames = self.repeated = self.still = 0
        self.first: int | None = None

    def add(self, reasons: tuple[Reason, ...]) -> None:
        """Count one frame."""
        if reasons and self.first is None:
            self.first = self.frames
        self.frames += 1
        self.repeated += Reason.FRAME_REPEATED in reasons
        self.still += Reason.PICTURE_STILL in reasons

    def figures(self) -> dict[str, Any]:
        """Return what is written of it."""
        return {"frames": self.frames, "frame_repeated": self.repeated, "picture_still": self.still}


def reasons(
    images: Iterable[Image], *, fresh_noise: bool = True, moving: bool | None = None
) -> Iterator[tuple[Reason, ...]]:
    """Yield the reasons of the stream checks; frames that show nothing are left out of them."""
    checks = StreamChecks()
    for image in images:
        look = Look(model_input(image, *SIZE, "none"), (image.shape[0], image.shape[1]))
        found = checks.picture(look, fresh_noise, moving)
        yield () if image_doubt(look) else found


def counted(images: Iterable[Image], *, fresh_noise: bool = True) -> Count:
    """Return the count of a whole stream."""
    count = Count()
    for found in reasons(images, fresh_noise=fresh_noise):
        count.add(found)
    return count


def read(folder: Path, most: int | None = None) -> Images:
    """Return the images of a folder, or the first of them in the size of a simulated camera."""
    found = islice((f.image for f in open_source(str(folder)) if f.image is not None), most)
    if most is None:
        return list(found)
    size = CAMERA[::-1]
    return [np.asarray(cv2.resize(i, size, interpolation=cv2.INTER_AREA), np.uint8) for i in found]


# --- codecs


def jpeg(quality: int) -> Callable[[Images], Images]:
    """Return a function that writes each image as a JPEG and reads it."""

    def coded(images: Images) -> Images:
        written = (cv2.imencode(".jpg", i, [cv2.IMWRITE_JPEG_QUALITY, quality])[1] for i in images)
        return [np.asarray(cv2.imdecode(w, cv2.IMREAD_COLOR), np.uint8) for w in written]

    return coded


def h264(crf: int) -> Callable[[Images], Images]:
    """Return a function that writes images as one H.264 video and reads it."""
    # Imported here, so that its absence is a message.
    import av

    def coded(images: Images) -> Images:
        # 4:2:0 needs even sides.
        height, width = (side - side % 2 for side in images[0].shape[:2])
        buffer = io.BytesIO()
        with av.open(buffer, "w", format="matroska") as output:
            stream = output.add_stream("libx264", rate=30, options={"crf": str(crf)})
            stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
            for image in images:
                whole = np.ascontiguousarray(image[:height, :width])
                output.mux(stream.encode(av.VideoFrame.from_ndarray(whole, format="bgr24")))
            output.mux(stream.encode())
        buffer.seek(0)
        with av.open(buffer) as stored:
            return [frame.to_ndarray(format="bgr24") for frame in stored.decode(video=0)]

    return coded


# --- cameras at which nothing is wrong


def noisy(images: Iterable[Image], deviation: float, seed: int = 0) -> Images:
    """Return the images with fresh noise."""
    generator = np.random.default_rng(seed)
    found = []
    for image in images:
        noise = generator.standard_normal(image.shape, np.float32)
        found.append(np.clip(np.rint(image + deviation * noise), 0, 255).astype(np.uint8))
    return found


def moved(image: Image, x: Iterable[float]) -> Images:
    """Return the image shifted to the left by ``x`` pixels, a margin of a tenth cut away."""
    height, width = image.shape[:2]
    margin = width // 10
    return [
        np.asarray(
            cv2.warpAffine(image, np.array([[1, 0, -value], [0, 1, 0]]), (width, height)), np.uint8
        )[:, margin : width - margin]
        for value in x
    ]


def creeping(image: Image, speed: float) -> Images:
    """Return a camera that moves by ``speed`` pixels a frame."""
    return moved(image, speed * (np.arange(FRAMES) - FRAMES / 2))


def returning(image: Image, amplitude: float, seed: int = 0) -> Images:
    """Return a camera that goes to and fro, four times, not always at the same speed."""
    steps = np.random.default_rng(seed).normal(1.0, 0.1, FRAMES)
    return moved(image, amplitude * np.sin(8.0 * np.pi * np.cumsum(steps) / FRAMES))


def vibrating(image: Image, amplitude: float, per_frame: float) -> Images:
    """Return a camera that rests on something that vibrates; ``per_frame`` is in turns."""
    return moved(image, amplitude * np.sin(2.0 * np.pi * per_frame * np.arange(FRAMES)))


def flickering(image: Image, depth: float) -> Images:
    """Return a camera at rest under a lamp of 100 Hz, at 30 frames a second, row after row."""
    rows = np.arange(len(image))[:, np.newaxis, np.newaxis] / len(image)
    return [
        np.clip(
            image * (1.0 + depth * np.sin(2.0 * np.pi * (100.0 * k / 30.0 + 2.0 * rows))), 0, 255
        ).astype(np.uint8)
        for k in range(FRAMES)
    ]


def passing(image: Image) -> Images:
    """Return a camera at rest before which somebody a third of the picture wide goes to and fro."""
    height, width = image.shape[:2]
    walker = np.ascontiguousarray(image[height // 6 :, : width // 3][:, ::-1])
    found = []
    for k in range(FRAMES):
        left = round((width - walker.shape[1]) * 0.5 * (1.0 - np.cos(2.0 * np.pi * k / 57.3)))
        picture = image.copy()
        picture[height // 6 :, left : left + walker.shape[1]] = walker
        found.append(picture)
    return found


def blameless(image: Image) -> Iterator[tuple[str, Images, bool]]:
    """Yield name, images and whether their noise is fresh, of cameras at which nothing is wrong."""
    for deviation in NOISES:
        still = noisy([image] * FRAMES, deviation)
        yield f"rest, noise {deviation:g}, raw", still, True
        for quality in (50, 75, 90):
            yield f"rest, noise {deviation:g}, JPEG {quality}", jpeg(quality)(still), True
        for crf in (18, 23, 28):
            yield f"rest, noise {deviation:g}, H.264 crf {crf}", h264(crf)(still), False
    walker = noisy(passing(image), 2.0)
    yield "rest, somebody passes, raw", walker, True
    yield "rest, somebody passes, JPEG 75", jpeg(75)(walker), True
    yield "rest, somebody passes, H.264 crf 28", h264(28)(walker), False
    for depth in (0.05, 0.2):
        yield f"rest, a lamp flickers by {depth:g}", noisy(flickering(image, depth), 2.0), True
    for per_frame in (0.335, 0.11):
        name = f"rest, vibration of 1 px, {per_frame:g} turns a frame"
        yield name, noisy(vibrating(image, 1.0, per_frame), 2.0), True
    for speed in (0.02, 0.1, 0.3):
        creep = noisy(creeping(image, speed), 2.0)
        yield f"creeps by {speed:g} px a frame, raw", creep, True
        yield f"creeps by {speed:g} px a frame, JPEG 75", jpeg(75)(creep), True
        yield f"creeps by {speed:g} px a frame, H.264 crf 28", h264(28)(creep), False
    for amplitude in (2.0, 10.0, 30.0):
        yield f"returns over {amplitude:g} px", noisy(returning(image, amplitude), 2.0), True


# --- streams that repeat themselves


def half_frozen(images: Images, begin: int) -> Images:
    """Return the images, the lower half from ``begin`` on that of one frame."""
    found = [image.copy() for image in images]
    for image in found[begin:]:
        image[len(image) // 2 :] = images[begin - 1][len(image) // 2 :]
    return found


def clock_over(image: Image, count: int) -> Images:
    """Return copies of an image with the number of the frame in a corner."""
    found = [image.copy() for _ in range(count)]
    for number, picture in enumerate(found):
        font = cv2.FONT_HERSHEY_SIMPLEX
        cv2.putText(picture, f"{number:06d}", (10, 30), font, 1.0, (255, 255, 255), 2)
    return found


def faulty(images: Images) -> Iterator[tuple[str, Images, int, dict[str, Any]]]:
    """Yield name, images, the first wrong one, and what the caller tells of the stream."""
    begin = len(images) // 3
    good, last = images[:begin], images[begin - 1]
    rest = len(images) - begin
    yield "frozen", good + [last] * rest, begin, {}
    yield "lower half frozen", half_frozen(images, begin), begin, {}
    yield "a clock over a still", good + clock_over(last, rest), begin + 1, {}
    for ring in (9, 40):
        cycled = [images[k % ring] for k in range(3 * ring)]
        yield f"ring of {ring} buffers", cycled, ring, {}
        again = noisy(cycled, 2.0)
        yield f"loop of {ring} frames, fresh noise", again, ring, {}
        yield f"loop of {ring} frames, H.264 crf 23", h264(23)(again), ring, {"fresh_noise": False}
    still = good + noisy([last] * rest, 2.0)
    coded, unfresh = h264(28)(good + [last] * rest), {"fresh_noise": False}
    yield "frozen, fresh noise, nothing told", still, begin, {}
    yield "frozen, fresh noise, motion expected", still, begin, {"moving": True}
    yield "frozen, H.264 crf 28, nothing told", coded, begin, unfresh
    yield "frozen, H.264 crf 28, motion expected", coded, begin, {**unfresh, "moving": True}


def of_recording(folders: list[Path]) -> dict[str, Any]:
    """Count alarms in whole recordings, without and with the hint; copies are no false alarms."""
    plain, hinted, copies, told = Count(), Count(), 0, 0
    for folder in folders:
        images = read(folder)
        twice = [False, *(np.array_equal(a, b) for a, b in pairwise(images))]
        found = list(reasons(images))
        copies += sum(twice)
        told += sum(copied and bool(f) for copied, f in zip(twice, found, strict=True))
        for copied, seen in zip(twice, found, strict=True):
            plain.add(() if copied else seen)
        for seen in reasons(images, moving=True):
            hinted.add(seen)
    return {
        "recordings": len(folders),
        "frames": plain.frames,
        "copies": copies,
        "copies_flagged": told,
        "false_alarms": plain.repeated,
        "picture_still_with_the_hint": hinted.still,
    }


def of_video(images: Images) -> dict[str, Any]:
    """Count alarms in a recording coded as H.264, as the runtime treats it and with equality on."""
    found = {}
    for crf in (18, 28):
        coded = h264(crf)(images)
        found[f"crf {crf}"] = {
            "frames": len(coded),
            "frame_repeated": counted(coded, fresh_noise=False).repeated,
            "frame_repeated_if_equality_counted": counted(coded).repeated,
        }
    return found


def cost_us(images: Images) -> float:
    """Return the processor time of the stream checks on one frame: the least of several rounds."""
    looks = [Look(model_input(image, *SIZE, "none"), image.shape[:2]) for image in images]
    checks = StreamChecks()

    def all_of_them() -> None:
        for look in looks:
            checks.picture(look)

    all_of_them()
    return round(
        1e6 * min(timeit.repeat(all_of_them, timer=process_time, number=1, repeat=20)) / len(looks),
        1,
    )


def main() -> None:
    """Count, print and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path, default=RESULTS / "vigilance" / "temporal.json")
    arguments = parser.parse_args()
    data = Path(os.environ["CVO_DATA"])
    folders = {name: sorted(data.glob(pattern)) for name, pattern in RECORDINGS.items()}
    report: dict[str, Any] = {"recordings": {}, "videos": {}, "blameless": {}, "faulty": {}}

    def add(kind: str, name: str, figures: dict[str, Any]) -> None:
        report[kind][name] = figures
        print(f"{kind:<11}{name:<45}{figures}", flush=True)

    starts = {name: read(found[0], LONGEST) for name, found in folders.items()}
    report["cost_us"] = cost_us(starts["redkitchen"])
    print(f"{report['cost_us']} us a frame")
    for name, found in folders.items():
        add("recordings", name, of_recording(found))
        add("videos", name, of_video(starts[name]))
    scenes = [read(CLIP, 1)[0], *(images[len(images) // 2] for images in starts.values())]
    blame: dict[str, Count] = {}
    switched: dict[str, int] = {}
    for image in scenes:
        for name, images, fresh in blameless(image):
            for seen in reasons(images, fresh_noise=fresh):
                blame.setdefault(name, Count()).add(seen)
            if not fresh:
                switched[name] = switched.get(name, 0) + counted(images).repeated
    for name, count in blame.items():
        figures = {"frames": count.frames, "frame_repeated": count.repeated}
        if name in switched:
            figures["frame_repeated_if_equality_counted"] = switched[name]
        add("blameless", name, figures)
    for name, start in starts.items():
        for kind, images, begin, told in faulty(start):
            # Before the fault, a recording's own copies are flagged.
            found_after = Count()
            for seen in list(reasons(images, **told))[begin:]:
                found_after.add(seen)
            figures = {**found_after.figures(), "unnoticed_at_first": found_after.first}
            add("faulty", f"{name}: {kind}", figures)
    write_result(arguments.json, report)


if __name__ == "__main__":
    main()
