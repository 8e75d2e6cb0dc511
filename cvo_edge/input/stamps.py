"""Stamps of frames: from the names of image files, or from a list.

===================================  ====================================  ====================
given                                stamps                                belong to
===================================  ====================================  ====================
``names``                            the number at the end of each name    the file
lines ``timestamp file`` (rgb.txt)   seconds                               files of that name
lines ``timestamp,file`` (data.csv)  integer nanoseconds                   files of that name
lines ``timestamp frame``            seconds                               frames of a video
lines ``timestamp,frame``            integer nanoseconds                   frames of a video
one number a line (times.txt)        seconds                               line i: frame i
===================================  ====================================  ====================

Frames of a video are numbered from 0. A number with a point is seconds. Integers since 1970 have 10
digits in seconds, 13 in milliseconds, 16 in microseconds and 19 in nanoseconds; others are not
taken as stamps.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from itertools import pairwise
from pathlib import Path, PurePosixPath

from cvo_edge.errors import SourceError
from cvo_edge.trajectories.tables import Row, first_line, read_rows, read_text, seconds_to_ns

NAMES = "names"

_AT_END = re.compile(r"(?:^|[^0-9.])([0-9]+(?:\.[0-9]+)?)$")
_UNITS = {10: 10**9, 13: 10**6, 16: 10**3, 19: 1}
# A number with fewer digits before the point may be anything, unless stamps were asked for.
_CERTAIN, _MOST = 9, 11
_LONGEST_NUMBER = 10
_FORM = "stamps: timestamp file, timestamp,file or a time a line"
_VIDEO_FORM = "stamps of a video: a time a line, timestamp frame or timestamp,frame"


def stamps_in_names(names: Iterable[str]) -> list[int] | None:
    """Return the stamps (ns) that names without suffix end with, or None.

    None unless all names have a stamp since 1970 and each is later than the one before.
    """
    known: list[int] = []
    for name in names:
        stamp = stamp_in_name(name)
        if stamp is None or (known and stamp <= known[-1]):
            return None
        known.append(stamp)
    return known


def stamp_in_name(name: str) -> int | None:
    """Return the stamp (ns) since 1970 that a name without suffix ends with, or None."""
    return _stamp(name, _CERTAIN)


def read_stamps(given: str, names: Sequence[str], files: Sequence[str]) -> list[int]:
    """Return the stamps (ns) of image files.

    Parameters
    ----------
    given
        ``names``, or the path of a list.
    names, files
        Each image's name without suffix and mark, and with them.

    Raises
    ------
    SourceError
        An image has no stamp, or one that is not later than the one before.
    """
    if given == NAMES:
        stamps = [_needed(_stamp(name, 1), file) for name, file in zip(names, files, strict=True)]
    else:
        stamps = _listed(Path(given), names, files)
    _check_rising(stamps, files)
    return stamps


def _check_rising(stamps: Sequence[int], frames: Sequence[str]) -> None:
    for place, (first, second) in enumerate(pairwise(stamps)):
        if second <= first:
            raise SourceError(
                f"stamps: expected each later than the one before, found {_seconds(first)} for "
                f"{frames[place]} and {_seconds(second)} for {frames[place + 1]}"
            )


class ListedStamps:
    """Stamps of a video's frames, from a list.

    The number of frames is certain only at the end of a video, as its container may announce none
    or another one.
    """

    def __init__(self, path: Path) -> None:
        """Read a list of times, or of times and frame numbers.

        Raises SourceError if a line is malformed, or a stamp is not later than the one before.
        """
        _, line = first_line(read_text(path, _VIDEO_FORM))
        if not line:
            raise SourceError(f"{path}: expected {_VIDEO_FORM}, found no line")
        self._path = path
        self._numbered = "," in line or len(line.split()) > 1
        if "," in line:
            rows = read_rows(path, "timestamp [ns],frame", separator=",", more=True)
            listed = [(_number(row), row.nanoseconds()) for row in rows]
        elif self._numbered:
            rows = read_rows(path, "timestamp frame", more=True)
            listed = [(_number(row), row.seconds()) for row in rows]
        else:
            listed = list(enumerate(row.seconds() for row in read_rows(path, "time")))
        # Of a frame that is listed twice, the first stamp counts.
        self._stamps_ns = dict(sorted(dict(reversed(listed)).items()))
        _check_rising(list(self._stamps_ns.values()), [f"frame {n}" for n in self._stamps_ns])
        self._seq = 0

    def check(self, announced: int | None) -> None:
        """Raise SourceError if a frame has no stamp, of those that the container announces."""
        missing = (seq for seq in range(announced or 0) if seq not in self._stamps_ns)
        if (seq := next(missing, None)) is not None:
            raise self._refusal(
                f"{announced} frames, as the video announces",
                self._none_for(seq)
                or "; if it holds fewer, ffmpeg -i VIDEO -c copy NEW.mp4 corrects its number",
            )

    def next(self, count: int, position_ms: float) -> list[int]:  # noqa: ARG002 - one protocol
        """Return the stamps of the next ``count`` frames, wherever they are in the container.

        Raises SourceError if a frame has none.
        """
        begin, self._seq = self._seq, self._seq + count
        for seq in range(begin, self._seq):
            if seq not in self._stamps_ns:
                raise self._refusal(f"{seq + 1} frames or more", self._none_for(seq))
        return [self._stamps_ns[seq] for seq in range(begin, self._seq)]

    def end(self) -> None:
        """Raise SourceError if a list of times without numbers is longer than the video."""
        if not self._numbered and self._seq < len(self._stamps_ns):
            raise self._refusal(
                f"{self._seq} frames, the whole video",
                "; times of dropped frames shift those after them: delete them, or write lines "
                "timestamp frame",
            )

    def _none_for(self, seq: int) -> str:
        return f", none for frame {seq}; frames count from 0" if self._numbered else ""

    def _refusal(self, frames: str, more: str) -> SourceError:
        count = len(self._stamps_ns)
        return SourceError(
            f"{self._path}: expected a stamp for each of {frames}, found {count}{more}"
        )


def _number(row: Row) -> int:
    """Return the second column, the number of a frame; raises SourceError."""
    digits = row.fields[1]
    if not (digits.isascii() and digits.isdecimal() and len(digits) <= _LONGEST_NUMBER):
        raise row.refusal()
    return int(digits)


def _listed(path: Path, names: Sequence[str], files: Sequence[str]) -> list[int]:
    _, line = first_line(read_text(path, _FORM))
    if "," in line:
        rows = read_rows(path, "timestamp,file", separator=",", more=True)
        return _by_name(path, [(row.nanoseconds(), row.fields[1]) for row in rows], files)
    if len(line.split()) > 1:
        rows = read_rows(path, "timestamp file", more=True)
        return _by_name(path, [(row.seconds(), row.fields[1]) for row in rows], files)
    if not line:
        raise SourceError(f"{path}: expected {_FORM}, found no line")
    times = [row.seconds() for row in read_rows(path, "time")]
    numbered = all(name.isdecimal() for name in names)
    places = [int(name) for name in names] if numbered else list(range(len(names)))
    if max(places) >= len(times) or (not numbered and len(places) != len(times)):
        raise SourceError(
            f"{path}: expected a time for each of {len(names)} frames"
            f"{f', numbers to {max(places)}' if numbered else ''}, found {len(times)}"
        )
    return [times[place] for place in places]


def _by_name(path: Path, listed: Sequence[tuple[int, str]], files: Sequence[str]) -> list[int]:
    stamps: dict[str, int] = {}
    for stamp, file in listed:
        stamps.setdefault(PurePosixPath(file).name, stamp)
    for file in files:
        if file not in stamps:
            raise SourceError(f"{path}: expected a stamp for {file}, found none")
    return [stamps[file] for file in files]


def _stamp(name: str, digits: int) -> int | None:
    """Return the stamp at the end of a name; seconds have at least ``digits`` before the point."""
    found = _AT_END.search(name)
    if found is None:
        return None
    whole, point, _ = found[1].partition(".")
    if point:
        return seconds_to_ns(found[1]) if digits <= len(whole) <= _MOST else None
    unit = _UNITS.get(len(whole))
    return int(whole) * unit if unit else None


def _needed(stamp: int | None, file: str) -> int:
    if stamp is None:
        raise SourceError(
            f"stamps: expected names that end in seconds with a point, or in an integer of "
            f"{', '.join(map(str, _UNITS))} digits (s, ms, us, ns), found {file}"
        )
    return stamp


def _seconds(stamp_ns: int) -> str:
    return f"{stamp_ns // 10**9}.{stamp_ns % 10**9:09d} s"
