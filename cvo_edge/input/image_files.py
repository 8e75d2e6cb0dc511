"""Image files as a source: a folder, a glob or a single file."""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from itertools import count, repeat
from pathlib import Path
from time import perf_counter
from typing import NamedTuple

from cvo_edge.errors import SourceError, printable
from cvo_edge.files import natural_text, read_regular_file
from cvo_edge.input.capture import shown
from cvo_edge.input.decoding import MAX_IMAGE_BYTES, decode_image, is_image
from cvo_edge.input.frame import Frame
from cvo_edge.input.half import not_half
from cvo_edge.input.stamps import read_stamps, stamps_in_names
from cvo_edge.vocabulary import Decode

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".ppm", ".pgm", ".tif", ".tiff", ".webp")
_JPEG_SUFFIXES = (".jpg", ".jpeg")
# Videos whose first bytes are those of an image.
_JPEGS_IN_A_ROW = (".mjpg", ".mjpeg")

# Poses, stamps and cameras are kept beside images.
BESIDE = frozenset((".txt", ".csv", ".json", ".yaml", ".yml"))
NOT_COLOUR = "not marked as colour"
# Words in a file's name that say what the image shows.
_COLOUR = frozenset(("color", "colour", "rgb"))
_NO_COLOUR = frozenset(
    ("depth", "disp", "disparity", "mask", "ir", "infrared", "normal", "normals")
)
# Most names hold none, and need not be taken apart.
_ANY_MARK = re.compile("|".join(sorted(_COLOUR | _NO_COLOUR)), re.IGNORECASE)
_WORD = re.compile("[A-Z]+(?![a-z])|[A-Z]?[a-z]+")
_COLOUR_SUFFIX = re.compile("[._-](color|colour|rgb)$")


class Listing(NamedTuple):
    """The images to use, in natural order, and the number of files left out, by reason.

    ``names`` are paths in ``folder``, or paths if that is empty: a folder may hold a million files.
    """

    folder: str
    names: list[str]
    left_out: dict[str, int]

    @property
    def images(self) -> list[Path]:
        """The paths of the images."""
        return [Path(self.folder, name) for name in self.names]


class ImageFiles:
    """Image files in the given order; an unreadable file is a frame without an image.

    Frames are stamped by ``stamps`` (see ``read_stamps``), by a rate, or by their names if all are
    stamps since 1970.
    """

    live = False

    def __init__(
        self,
        listing: Listing,
        fps: float | None,
        if_empty: str,
        stamps: str | None = None,
        bits: int = 16,
    ) -> None:
        self._bits = bits
        self._decode: Decode = "full"
        self._folder, self._names, self.left_out = listing
        if not self._names:
            reasons = f"; left out {left_out_text(self.left_out)}" if self.left_out else ""
            raise SourceError(if_empty + reasons)
        files = map(os.path.basename, self._names)
        self._stamps_ns: Iterable[int | None]
        if stamps is not None:
            listed = list(files)
            self._stamps_ns = read_stamps(stamps, list(map(frame_name, listed)), listed)
        elif fps is not None:
            self._stamps_ns = map(partial(stamp_at, fps=fps), count())
        else:
            self._stamps_ns = stamps_in_names(map(frame_name, files)) or repeat(None)
        self.length: int | None = len(self._names)

    @property
    def paths(self) -> Iterator[str]:
        """The files, in order."""
        return (os.path.join(self._folder, name) for name in self._names)  # noqa: PTH118

    def halve(self) -> None:
        """Decode at half size; raises UsageError for a file that is named as no JPEG."""
        for name in self._names:
            if not name.lower().endswith(_JPEG_SUFFIXES):
                raise not_half(shown(Path(name).name))
        self._decode = "half"

    def reads(self) -> Iterator[Callable[[], Frame]]:
        """Yield one call a file."""
        for path, stamp_ns in zip(self.paths, self._stamps_ns, strict=False):
            yield partial(read_image_file, path, stamp_ns, self._bits, self._decode)

    def __iter__(self) -> Iterator[Frame]:
        """Yield one frame a file."""
        for read in self.reads():
            yield read()


def read_image_file(
    path: str, stamp_ns: int | None, bits: int = 16, decode: Decode = "full"
) -> Frame:
    """Read and decode one image file; a frame without an image if that fails."""
    start = perf_counter()
    try:
        content = read_regular_file(path, MAX_IMAGE_BYTES, SourceError, links=True)
        image = decode_image(content, bits, decode)
    except SourceError:
        image = None
    spent = 1e3 * (perf_counter() - start)
    return Frame(image, stamp_ns, shown(os.path.basename(path)), spent)  # noqa: PTH119


def images_in(folder: Path) -> Listing:
    """Return the images of a folder, without hidden files; see ``colour_images``.

    A link counts as the file that it names, also if that is missing: its frame has no image.

    Raises SourceError if the folder cannot be read.
    """
    others: Counter[str] = Counter()
    files: list[str] = []
    try:
        with os.scandir(folder) as entries:
            for entry in entries:
                # macOS leaves a hidden file beside each file on a card.
                if entry.name.startswith("."):
                    continue
                if reason := not_a_file(entry):
                    others[reason] += has_image_suffix(entry.name)
                else:
                    files.append(entry.name)
    except OSError as error:
        raise SourceError(f"{shown(str(folder))}: cannot be read: {error.strerror}") from None
    return colour_images(files, str(folder), others)


def not_a_file(entry: os.DirEntry[str]) -> str:
    """Return why an entry of a folder is no file: ``a folder``; empty if it is one, or a link."""
    # No status of files is asked for, which would take long for many of them.
    try:
        if entry.is_file(follow_symlinks=False):
            return ""
        if entry.is_dir():
            return "a folder"
    except OSError:
        pass  # a link to itself, or to a place that may not be read
    return "" if entry.is_symlink() else "no regular file"


def has_image_suffix(name: str) -> bool:
    """Whether a name ends as that of an image does."""
    return name.lower().endswith(IMAGE_SUFFIXES)


def colour_images(
    files: Iterable[str], folder: str = "", others: Mapping[str, int] | None = None
) -> Listing:
    """Return the images among files by the marks in their names.

    A mark is a word of the name, e.g. ``depth`` in ``00001-depth.png``. Images marked as anything
    but colour are left out; if some of the others are marked as colour, only those are used.
    Files with another suffix are counted, too, but for those of poses and lists. ``others`` are
    what was left out before.
    """
    unmarked: list[str] = []
    colour: list[str] = []
    left_out = Counter(others or {})
    for file in files:
        is_colour, reason = mark_of(file.rpartition("/")[2])
        if reason in BESIDE:
            continue
        if reason:
            left_out[reason] += 1
        else:
            (colour if is_colour else unmarked).append(file)
    if colour and unmarked:
        left_out[NOT_COLOUR] = len(unmarked)
    images = colour or unmarked
    # Names that differ in leading zeros alone come in one order, whatever that of the folder is.
    images.sort()
    images.sort(key=natural_text)
    return Listing(folder, images, {key: n for key, n in sorted(left_out.items()) if n})


def mark_of(name: str) -> tuple[bool, str]:
    """Return whether a file is marked as a colour image, and why it is no frame, if it is none."""
    if not has_image_suffix(name):
        return False, os.path.splitext(name)[1].lower() or "without suffix"  # noqa: PTH122
    if not _ANY_MARK.search(name):
        return False, ""
    words = {word.lower() for word in _WORD.findall(name, 0, name.rindex("."))}
    if found := words & _NO_COLOUR:
        return False, f"marked {min(found)}"
    return bool(words & _COLOUR), ""


def left_out_text(left_out: Mapping[str, int]) -> str:
    """Return the number of files left out and the reasons: ``50 files: marked depth 50``."""
    total = sum(left_out.values())
    reasons = ", ".join(f"{printable(reason)} {number}" for reason, number in left_out.items())
    return f"{total} file{'' if total == 1 else 's'}: {reasons}"


def is_one_image(path: Path) -> bool:
    """Whether a file without an image's suffix is one; FFmpeg would read it as a video."""
    if path.suffix.lower() in _JPEGS_IN_A_ROW:
        return False
    try:
        with path.open("rb") as stream:
            return is_image(stream.read(16))
    except OSError:
        return False


def frame_name(file_name: str) -> str:
    """Return an image's name without suffix and mark: ``00001`` for ``00001-color.png``."""
    return _COLOUR_SUFFIX.sub("", os.path.splitext(file_name)[0])  # noqa: PTH122


def stamp_at(seq: int, fps: float | None) -> int | None:
    """Return the stamp of frame ``seq`` at a rate, in ns from zero; None without a rate."""
    return None if fps is None else round(seq * 1_000_000_000 / fps)
