"""What the commands on trajectories share: which files belong together, and their reading."""

from __future__ import annotations

import math
import re
import shlex
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from hashlib import sha256
from itertools import takewhile
from pathlib import Path
from typing import NamedTuple

import numpy as np

from cvo_edge import geometry
from cvo_edge.errors import SourceError, UsageError, printable
from cvo_edge.motion.alignment import LEAST_MOTIONS, MOST_OFFSET_S, Alignment
from cvo_edge.motion.corrections import Fit, corrected, fit_of
from cvo_edge.motion.files import Poses, read_poses
from cvo_edge.motion.format import CorrectionSpec
from cvo_edge.motion.pairs import Pair, pair_of
from cvo_edge.spread import Here, Spread
from cvo_edge.trajectories.tables import read_text
from cvo_edge.vocabulary import MOTION_CORRECTIONS, MotionCorrection, TrajectoryFormat

# Scales of recordings of one estimator may differ by this factor.
MOST_SPREAD = 1.1
# Of motions, what is left over in files that are the same, and in files of different drives.
_SAME, _OTHER = 1e-3, 0.5
# So many names stand in a line.
MOST_NAMES = 5
_FORM = "estimate truth [group [times]]"


class Files(NamedTuple):
    """An estimate, its truth, the drive that they are of, and a file of times."""

    estimate: Path
    truth: Path
    group: str | None = None
    times: Path | None = None

    @property
    def paths(self) -> list[Path]:
        """All files."""
        return [path for path in (self.estimate, self.truth, self.times) if path]


class Reading(NamedTuple):
    """How files are read: their format, and times for formats without."""

    format: TrajectoryFormat | None = None
    times: Path | None = None
    fps: float | None = None

    def one(self, path: Path) -> Poses:
        """Read the only file of a command; raises SourceError and UsageError."""
        poses = self.poses(path)
        self.check_used(poses.timed)
        return poses

    def check_used(self, timed: bool) -> None:
        """Raise UsageError if times were given for files that all have their own."""
        if self.times is not None and self.fps is not None:
            raise UsageError("--times, --fps: expected one of them, found both")
        if not timed and (self.times is not None or self.fps is not None):
            option = "--times" if self.fps is None else "--fps"
            raise UsageError(
                f"{option}: expected poses without times (kitti), found stamps in the files; leave "
                "it out"
            )

    def poses(self, path: Path, times: Path | None = None) -> Poses:
        """Read one of several files; raises SourceError and UsageError."""
        if self.fps is not None and not math.isfinite(self.fps):
            raise UsageError(f"--fps: expected a number, found {self.fps}")
        return read_poses(path, self.format).stamped(times or self.times, self.fps)


def listed_files(given: Sequence[Path], pairs: Path | None, groups: Sequence[str]) -> list[Files]:
    """Return the pairs of a command line: EST GT [EST GT ...] or a list, and their groups.

    Raises UsageError for an odd number of files or of groups, SourceError for a malformed list.
    """
    if len(given) % 2:
        raise UsageError(f"files: expected pairs EST GT, found {len(given)} files")
    files = [Files(est, gt) for est, gt in zip(given[::2], given[1::2], strict=True)]
    if pairs is not None:
        files += _listed(pairs)
    if not files:
        found = "none" if pairs is None else f"no line in {pairs}"
        raise UsageError(f"files: expected EST GT [EST GT ...] or --pairs FILE, found {found}")
    if groups:
        if len(groups) != len(files):
            raise UsageError(
                f"--group: expected one for each of {len(files)} pairs, found {len(groups)}"
            )
        files = [each._replace(group=group) for each, group in zip(files, groups, strict=True)]
    return files


def _listed(path: Path) -> list[Files]:
    """Read lines ``estimate truth [group [times]]``; paths are relative to the list's folder."""
    files = []
    for number, line in enumerate(read_text(path, _FORM).splitlines(), start=1):
        try:
            words = shlex.split(line, comments=True)
        except ValueError:
            words = [line]
        if not words:
            continue
        if not 2 <= len(words) <= 4 or not all(words):
            raise SourceError(
                f"{path}: expected {_FORM}, names with spaces in quotes, found {line[:80]!r} in "
                f"line {number}"
            )
        group = words[2] if len(words) > 2 else None
        times = path.parent / words[3] if len(words) > 3 else None
        files.append(Files(path.parent / words[0], path.parent / words[1], group, times))
    return files


class ReadPairs(NamedTuple):
    """Pairs, and lines on what was seen of their drives."""

    pairs: Spread[Pair]
    notes: list[str]


def read_pairs(
    files: Sequence[Files],
    reading: Reading,
    spread: Callable[[Sequence[Files]], Spread[Files]] = Here,
) -> ReadPairs:
    """Read pairs, in this process or where ``spread`` puts them.

    Estimates of one truth, or of copies of it, are one group, unless others are given.

    Raises SourceError and UsageError.
    """
    names = _names([each.estimate for each in files])
    pairs = spread(files).map(partial(_read, reading=reading, last={}), names, what="reading")
    seen = pairs.map(_seen, what="reading").collect()
    reading.check_used(
        any(timed for (_, timed), each in zip(seen, files, strict=True) if each.times is None)
    )
    groups, notes = _groups(files, names, [truth for truth, _ in seen])
    return ReadPairs(pairs.map(_grouped, groups), notes)


def _read(
    files: Files, name: str, reading: Reading, last: dict[tuple[Path, Path | None], Poses]
) -> Pair:
    """Read a pair without a group; ``last`` keeps one truth, which often serves several."""
    key = (files.truth.resolve(), files.times)
    if key not in last:
        truth = reading.poses(files.truth, files.times)
        last.clear()
        last[key] = truth
    pair = pair_of(name, "", reading.poses(files.estimate, files.times), last[key])
    if files.times is not None and not pair.timed:
        raise UsageError(
            f"{files.times}: expected poses without times (kitti), found stamps in "
            f"{files.estimate} and {files.truth}; leave it out"
        )
    return pair


def _grouped(pair: Pair, group: str) -> Pair:
    return replace(pair, group=group)


def _seen(pair: Pair) -> tuple[str, bool]:
    """Return what tells one truth from another, and whether a file has no times."""
    return sha256(pair.track.poses.tobytes()).hexdigest(), pair.timed


def _groups(
    files: Sequence[Files], names: Sequence[str], truths: Sequence[str]
) -> tuple[list[str], list[str]]:
    """Return the group of each pair, and lines on truths of several files or groups."""
    drives = _names([each.truth.resolve() for each in files])
    alike: dict[str, list[int]] = {}
    for place, truth in enumerate(truths):
        alike.setdefault(truth, []).append(place)
    groups, notes = [""] * len(files), []
    for places in alike.values():
        given = sorted({group for place in places if (group := files[place].group)})
        own = given[0] if len(given) == 1 else min(drives[place] for place in places)
        for place in places:
            groups[place] = files[place].group or own
        if len(given) > 1:
            called = _listed_names([names[place] for place in places])
            notes.append(
                f"doubt: {called}: their truths have the same poses, but they count as drives "
                f"{_listed_names(given)}"
            )
        elif len(copies := sorted({drives[place] for place in places})) > 1:
            notes.append(f"one drive: the truths {_listed_names(copies)} have the same poses")
    return groups, notes


def _listed_names(names: Sequence[str]) -> str:
    """Return a few names with commas."""
    more = f" and {len(names) - MOST_NAMES} more" if len(names) > MOST_NAMES else ""
    return ", ".join(map(printable, names[:MOST_NAMES])) + more


def _names(paths: Sequence[Path]) -> list[str]:
    """Return the paths without suffixes, and without the folders and names that all share."""
    parts = [path.absolute().with_suffix("").parts for path in paths]
    rest = [part[min(_alike(parts), len(part) - 1) :] for part in parts]
    ends = _alike([part[::-1] for part in rest])
    return ["/".join(part[: max(1, len(part) - ends)]) for part in rest]


def _alike(parts: Sequence[Sequence[str]]) -> int:
    """Return how many parts all begin with."""
    return len(list(takewhile(lambda column: len(set(column)) == 1, zip(*parts, strict=False))))


def fits(pairs: Spread[Pair]) -> list[Fit]:
    """Compare the trajectories of each pair; those of steps without a scale if they can be.

    Raises SourceError for a pair with too few motions, and for one in other units.
    """
    found = pairs.map(_fit, what="alignment").collect()
    return [fit for fit in found if fit is not None]


def _fit(pair: Pair) -> Fit | None:
    alignment = pair.aligned()
    if alignment is None and pair.unscaled:
        return None
    if alignment is None:
        raise SourceError(
            f"{pair.name}: expected at least {LEAST_MOTIONS} motions of half a second, or from "
            "keyframe to keyframe, with a truth that moves, found fewer among "
            f"{len(pair.stamps_ns)} poses"
        )
    _check_fit(pair, alignment)
    fit = fit_of(pair, alignment)
    if pair.unscaled:
        # Its scale is that of the steps, which nobody could correct.
        return fit._replace(effects={each: fit.effects[each] for each in ("time", "frame")})
    if fit.unit is not None:
        raise SourceError(
            f"{pair.name}: expected metres in both files, found motions of the truth that are "
            f"{alignment.scale:.4g} times the estimate's; convert one of them"
        )
    return fit


def _check_fit(pair: Pair, alignment: Alignment) -> None:
    """Raise SourceError for two files that are not of one drive, or are one and the same."""
    rotation, translation = alignment.misfit.tolist()
    if max(rotation, translation) < _SAME:
        raise SourceError(
            f"{pair.name}: expected an estimate with its truth, found the same motions in both"
        )
    if min(rotation, translation) > _OTHER or alignment.scale <= 0.0:
        raise SourceError(
            f"{pair.name}: expected two trajectories of one drive, found motions that do not fit: "
            f"{min(rotation, 9.99):.0%} of rotations and {min(translation, 9.99):.0%} of "
            "translations are left over; check the pair, stamps and the quaternions' order "
            "(qx qy qz qw)"
        )
    if abs(alignment.offset_s) >= MOST_OFFSET_S:
        raise SourceError(
            f"{pair.name}: expected stamps that differ by less than {MOST_OFFSET_S:g} s, found "
            f"{alignment.offset_s:.3f} s"
        )


def wanted_corrections(text: str | None) -> tuple[MotionCorrection, ...]:
    """Return the corrections of a list ``time,frame,scale``; raises UsageError for others."""
    words = [word for word in re.split(r"[,\s]+", text or "") if word]
    known = {str(each): each for each in MOTION_CORRECTIONS}
    for word in words:
        if word not in known:
            raise UsageError(
                f"--correct: expected any of {','.join(MOTION_CORRECTIONS)}, found {word}"
            )
    return tuple(each for each in MOTION_CORRECTIONS if each in words)


def correct_pairs(
    pairs: Spread[Pair], fits: Sequence[Fit], wanted: Sequence[MotionCorrection]
) -> tuple[Spread[Pair], CorrectionSpec]:
    """Return pairs with their own time and frame corrected, and with one scale for all.

    Raises UsageError for scales that differ by more than a tenth: no number corrects them.
    """
    if not wanted:
        return pairs, CorrectionSpec(offset_s=None, q_xyzw=None, scale=None)
    if len(fits) < len(pairs):
        raise UsageError(
            "--correct: expected drives that are long enough to be compared, found "
            f"{len(pairs) - len(fits)} of {len(pairs)} with fewer than {LEAST_MOTIONS} motions"
        )
    if "scale" in wanted and any("scale" not in fit.effects for fit in fits):
        raise UsageError("--correct scale: expected estimates in metres, found steps without scale")
    alignments = [fit.alignment for fit in fits]
    scale = None
    if "scale" in wanted:
        scales = [each.scale for each in alignments]
        if max(scales) > MOST_SPREAD * min(scales):
            raise UsageError(
                f"--correct scale: expected one scale of all recordings, found {min(scales):.3f} "
                f".. {max(scales):.3f}; leave it out, or scale each file"
            )
        scale = float(f"{np.median(scales):.6g}")
    each_its_own = [each for each in wanted if each != "scale"]
    own = pairs.map(partial(corrected, wanted=each_its_own, scale=scale), alignments)
    turns = np.array([geometry.quaternion_exp(each.determined_rotation) for each in alignments])
    turn = geometry.mean_rotation(turns).tolist() if "frame" in wanted else None
    offset_s = float(np.median([each.offset_s for each in alignments]))
    return own, CorrectionSpec(
        offset_s=round(offset_s, 6) if "time" in wanted else None,
        q_xyzw=tuple(turn) if turn else None,
        scale=scale,
    )
