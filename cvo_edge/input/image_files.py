"""Image files as a source: a folder, a glob or a single file."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import NamedTuple

from cvo_edge.errors import SourceError
from cvo_edge.files import natural_key, read_regular_file
from cvo_edge.input.capture import shown
from cvo_edge.input.decoding import MAX_IMAGE_BYTES, decode_image
from cvo_edge.input.frame import Frame
from cvo_edge.input.stamps import read_stamps, stamps_in_names

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".ppm", ".pgm", ".tif", ".tiff", ".webp")


# Words in a file's name that say what the image shows.
_COLOUR = frozenset(("color", "colour", "rgb"))
_NO_COLOUR = frozenset(
    ("depth", "disp", "disparity", "mask", "ir", "infrared", "normal", "normals")
)
_WORD = re.compile("[A-Z]+(?![a-z])|[A-Z]?[a-z]+")
_COLOUR_SUFFIX = re.compile("[._-](color|colour|rgb)$")


class Listing(NamedTuple):
    """The images to use, in natural order, and the number of images left out, by reason."""

    images: list[Path]
    left_out: dict[str, int]


class ImageFiles:
    """Image files in the given order; an unreadable file is a frame without an image.

    Frames are stamped by ``stamps`` (see ``read_stamps``), by a rate, or by their names if all are
    stamps since 1970.
    """

    live = False

    def __init__(
        self, listing: Listing, fps: float | None, if_empty: str, stamps: str | None = None
    ) -> None:
        paths, self.left_out = listing
        if not paths:
            reasons = f"; left out {left_out_text(self.left_out)}" if self.left_out else ""
            raise SourceError(if_empty + reasons)
        self._paths = paths
        names = [frame_name(path.name) for path in paths]
        self._stamps_ns: Sequence[int | None]
        if stamps is not None:
            self._stamps_ns = read_stamps(stamps, names, [path.name for path in paths])
        elif fps is not None:
            self._stamps_ns = [stamp_at(seq, fps) for seq in range(len(paths))]
        else:
            self._stamps_ns = stamps_in_names(names) or [None] * len(paths)
        self.length: int | None = len(paths)

    def reads(self) -> Iterator[Callable[[], Frame]]:
        """Yield one call a file."""
        for path, stamp_ns in zip(self._paths, self._stamps_ns, strict=True):
            yield partial(_read_file, path, stamp_ns)

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


def images_in(folder: Path) -> Listing:
    """Return the images of a folder, without hidden files; see ``colour_images``."""
    # macOS leaves a hidden file beside each file on a card.
    return colour_images(
        [path for path in folder.iterdir() if path.is_file() and not path.name.startswith(".")]
    )


def colour_images(paths: Iterable[Path]) -> Listing:
    """Return the images among files by the marks in their names.

    A mark is a word of the name, e.g. ``depth`` in ``00001-depth.png``. Images marked as anything
    but colour are left out; if some of the others are marked as colour, only those are used.
    """
    unmarked: list[Path] = []
    colour: list[Path] = []
    left_out: Counter[str] = Counter()
    for path in paths:
        if path.suffix.lower() not in IMAGE_SUFFIXES:
            continue
        words = {word.lower() for word in _WORD.findall(path.stem)}
        if words & _NO_COLOUR:
            left_out[f"marked {min(words & _NO_COLOUR)}"] += 1
        else:
            (colour if words & _COLOUR else unmarked).append(path)
    if colour and unmarked:
        left_out["not marked as colour"] = len(unmarked)
    return Listing(sorted(colour or unmarked, key=natural_key), dict(sorted(left_out.items())))


def left_out_text(left_out: Mapping[str, int]) -> str:
    """Return the number of images left out and the reasons: ``50 images: marked depth 50``."""
    count = sum(left_out.values())
    reasons = ", ".join(f"{reason} {number}" for reason, number in left_out.items())
    return f"{count} image{'' if count == 1 else 's'}: {reasons}"


def frame_name(file_name: str) -> str:
    """Return an image's name without suffix and mark: ``00001`` for ``00001-color.png``."""
    return _COLOUR_SUFFIX.sub("", Path(file_name).stem)


def stamp_at(seq: int, fps: float | None) -> int | None:
    """Return the stamp of frame ``seq`` at a rate, in ns from zero; None without a rate."""
    return None if fps is None else round(seq * 1_000_000_000 / fps)
