"""Recordings without poses: their motion, and the images of the frames that are used."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import msgspec
from msgspec import Struct

from cvo_edge.errors import SourceError, UsageError
from cvo_edge.files import write_whole
from cvo_edge.input.frame import Frame
from cvo_edge.input.image_files import images_in
from cvo_edge.input.pipes import names_pipe
from cvo_edge.input.sources import names_camera, open_source
from cvo_export.files import write_json
from cvo_export.progress import Progress
from cvo_export.reconstruct.choice import Image, motion, sharpness, small_grey

_QUALITY = [cv2.IMWRITE_JPEG_QUALITY, 95]
_SUFFIX = ".jpg"


class Recording(Struct, frozen=True):
    """A video file or a folder of images.

    ``name`` is unique in the scene; ``identity`` tells whether the content is still the same.
    """

    name: str
    path: str
    identity: tuple[int, int, int]


class Motion(Struct, frozen=True):
    """What was measured in each frame of a recording, by frame number.

    ``motions`` are in image widths from the frame before, ``sharpnesses`` -1 for a frame that
    cannot be read. ``width`` and ``height`` are the images' size in pixels.
    """

    width: int
    height: int
    motions: list[float]
    sharpnesses: list[float]
    sources: list[str]
    stamps_ns: list[int | None]

    @property
    def readable(self) -> list[int]:
        """Numbers of the frames that can be read."""
        return [number for number, value in enumerate(self.sharpnesses) if value >= 0.0]


def find_recordings(paths: Sequence[str]) -> list[Recording]:
    """Return the recordings with their names; raises SourceError or UsageError."""
    found: list[Recording] = []
    for text in paths:
        path = Path(text)
        if names_camera(text) or names_pipe(text):
            found_kind = "a camera" if names_camera(text) else "a pipe"
            raise UsageError(
                f"{text}: expected a video file or a folder of images, found {found_kind}"
            )
        if not path.exists():
            raise SourceError(f"{text}: expected a video file or a folder of images, found neither")
        stem = path.resolve().name if path.is_dir() else path.stem
        base = re.sub(r"[^A-Za-z0-9._-]+", "-", stem).strip(".-") or "recording"
        taken = {each.name for each in found}
        number, name = 1, base
        while name in taken:
            number += 1
            name = f"{base}-{number}"
        found.append(Recording(name, text, _identity(path)))
    return found


def _identity(path: Path) -> tuple[int, int, int]:
    files = images_in(path).images if path.is_dir() else [path]
    found = [file.stat() for file in files]
    if not found:
        raise SourceError(f"{path}: expected images, found none")
    newest = max(entry.st_mtime_ns for entry in found)
    return len(found), sum(entry.st_size for entry in found), newest


def image_name(recording: str, number: int) -> str:
    """Return the name of an image below ``images/``: ``VIDEO/frame-NNNNNN.jpg``."""
    return f"{recording}/frame-{number:06d}{_SUFFIX}"


def frame_of(name: str) -> tuple[str, int]:
    """Return recording and frame number of ``VIDEO/frame-NNNNNN``; raises UsageError."""
    match = re.fullmatch(r"([^/]+)/frame-(\d+)(?:\.jpg)?", name)
    if match is None:
        raise UsageError(f"frame: expected VIDEO/frame-NNNNNN, found {name}")
    return match[1], int(match[2])


def measure(recording: Recording, file: Path, progress: Progress) -> Motion:
    """Return motion and sharpness of all frames of a recording, kept in a file.

    Raises SourceError if the recording cannot be read, or its images differ in size.
    """
    try:
        return msgspec.json.decode(file.read_bytes(), type=Motion)
    except (OSError, msgspec.DecodeError, UnicodeDecodeError):
        pass
    size: tuple[int, int] | None = None
    before: Image | None = None
    found = Motion(0, 0, [], [], [], [])
    source = open_source(recording.path)
    for frame in source:
        found.sources.append(frame.source)
        found.stamps_ns.append(frame.stamp_ns)
        if frame.image is None:
            found.motions.append(0.0)
            found.sharpnesses.append(-1.0)
            continue
        size = _same_size(recording, frame, size)
        small = small_grey(frame.image)
        found.motions.append(0.0 if before is None else motion(before, small))
        found.sharpnesses.append(sharpness(frame.image))
        before = small
        done = len(found.sources)
        progress("motion", done, max(source.length or done, done), recording.name)
    if size is None:
        raise SourceError(f"{recording.path}: expected images, found none that can be read")
    whole = msgspec.structs.replace(found, height=size[0], width=size[1])
    write_json(file, whole)
    return whole


def _same_size(recording: Recording, frame: Frame, size: tuple[int, int] | None) -> tuple[int, int]:
    height, width = frame.image.shape[:2]  # type: ignore[union-attr]
    if size is not None and size != (height, width):
        raise SourceError(
            f"{recording.path}: expected images of {size[1]}x{size[0]} pixels like the first, "
            f"found {width}x{height} in {frame.source}; one recording has one camera"
        )
    return height, width


def write_images(
    recording: Recording, numbers: Sequence[int], folder: Path, progress: Progress
) -> None:
    """Write the images of some frames, and remove those of others; keep what is there.

    Raises SinkError, or SourceError if the recording has become unreadable.
    """
    wanted = {image_name(recording.name, number) for number in numbers}
    for path in (folder / recording.name).glob(f"*{_SUFFIX}"):
        if f"{recording.name}/{path.name}" not in wanted:
            path.unlink()
    missing = {n for n in numbers if not (folder / image_name(recording.name, n)).is_file()}
    written = len(wanted) - len(missing)
    for number, frame in _frames(recording, missing):
        if frame.image is None:
            raise SourceError(f"{recording.path}: {frame.source} can no longer be read")
        _, content = cv2.imencode(_SUFFIX, frame.image, _QUALITY)
        path = folder / image_name(recording.name, number)
        write_whole(path, content.tobytes(), make_folder=True)
        written += 1
        progress("images", written, len(wanted), recording.name)


def _frames(recording: Recording, numbers: set[int]) -> Iterator[tuple[int, Frame]]:
    """Yield frames by number, reading no further than necessary."""
    if not numbers:
        return
    last = max(numbers)
    for number, read in enumerate(open_source(recording.path).reads()):
        if number in numbers:
            yield number, read()
        if number == last:
            return
