"""Image files as a source: a folder, a glob or a single file."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from time import perf_counter

from cvo_edge.errors import SourceError
from cvo_edge.files import read_regular_file
from cvo_edge.input.capture import shown
from cvo_edge.input.decoding import MAX_IMAGE_BYTES, decode_image
from cvo_edge.input.frame import Frame

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".ppm", ".pgm", ".tif", ".tiff", ".webp")


def natural_key(path: Path) -> list[tuple[int, int, str]]:
    """Sort key that compares digits as numbers: ``frame-2`` before ``frame-10``."""
    parts = re.split("([0-9]+)", str(path))
    return [
        (1, 0, part) if index % 2 == 0 else (0, int(part), "")
        for index, part in enumerate(parts)
        if part
    ]


class ImageFiles:
    """Image files in the given order; an unreadable file is a frame without an image."""

    live = False

    def __init__(self, paths: list[Path], fps: float | None, if_empty: str) -> None:
        if not paths:
            raise SourceError(if_empty)
        self._paths = paths
        self._fps = fps
        self.length: int | None = len(paths)

    def reads(self) -> Iterator[Callable[[], Frame]]:
        """Yield one call a file."""
        for seq, path in enumerate(self._paths):
            yield partial(_read_file, path, stamp_at(seq, self._fps))

    def __iter__(self) -> Iterator[Frame]:
        """Yield one frame a file."""
        for read in self.reads():
            yield read()


def _read_file(path: Path, stamp_ns: int | None) -> Frame:
    start = perf_counter()
    try:
        content = read_regular_file(path, MAX_IMAGE_BYTES, SourceError, links=True)
        image = decode_image(content)
    except SourceError:
        image = None
    spent = 1e3 * (perf_counter() - start)
    return Frame(image, stamp_ns, shown(path.name), spent)


def images_in(folder: Path) -> list[Path]:
    """Return the images of a folder in natural order, without hidden files."""
    # macOS leaves a hidden file beside each file on a card.
    return colour_images(
        [path for path in folder.iterdir() if path.is_file() and not path.name.startswith(".")]
    )


def colour_images(paths: list[Path]) -> list[Path]:
    """Return the images among files in natural order, only ``*.color.*`` if there are any."""
    images = [path for path in paths if path.suffix.lower() in IMAGE_SUFFIXES]
    images = [path for path in images if ".depth." not in path.name]
    colour = [path for path in images if ".color." in path.name]
    return sorted(colour or images, key=natural_key)


def stamp_at(seq: int, fps: float | None) -> int | None:
    """Return the stamp of frame ``seq`` at a rate, in ns from zero; None without a rate."""
    return None if fps is None else round(seq * 1_000_000_000 / fps)
