"""Describe a data set as text: what was read, how the camera moves, and what looks wrong."""

from __future__ import annotations

from typing import get_args

import numpy as np
from numpy.typing import NDArray

from cvo_edge.bundle.format import StillDof
from cvo_edge.input.image_files import left_out_text
from cvo_export.datasets.agreement import READ, Agreement, agreement_of
from cvo_export.datasets.base import PoseDataset, skipped_text
from cvo_export.datasets.motion import MAX_SPREAD_RAD, Motion, motion_of, up_of
from cvo_export.datasets.sizes import image_sizes, sizes_text

Array = NDArray[np.float64]

# No camera is faster, no place larger: positions beyond these are not in metres.
_FASTEST, _FARTHEST_M = 150.0, 500.0
# Jumps that are named; the others are counted.
_NAMED = 3


def summary(dataset: PoseDataset) -> str:
    """Return one line with name, frames, sequences and skipped frames."""
    frames = _counted(len(dataset), "frame")
    sequences = _counted(len(dataset.sequence_names), "sequence")
    return f"{dataset.name:<11} {frames} in {sequences}; {skipped_text(dataset.skipped)}"


def describe(dataset: PoseDataset) -> list[str]:
    """Return the summary, images, camera, motion, time, what looks wrong, and each sequence.

    Reads the headers of all images and about two dozen whole images.

    Raises SourceError if the first image cannot be read.
    """
    height, width = dataset.read_image(0).shape[:2]
    sizes = image_sizes(dataset)
    mixed = f"; of several sizes: {sizes_text(sizes)}" if len(sizes) > 1 else ""
    if dataset.image_size is not None and (damaged := len(dataset) - sizes.total()):
        mixed += f"; {_counted(damaged, 'damaged image')}, training refuses them"
    camera = "not stated"
    if dataset.intrinsics is not None:
        numbers = dataset.intrinsics._asdict()
        camera = ", ".join(f"{name} {value:.1f}" for name, value in numbers.items()) + " px"
        if dataset.lens.distortion != "none":
            values = " ".join(f"{value:g}" for value in dataset.lens.coefficients)
            camera += f", distortion {dataset.lens.distortion.replace('_', '-')} {values}"
    motion = motion_of(dataset)
    agreement = agreement_of(dataset)
    return [
        summary(dataset),
        *([f"read        {dataset.chosen}"] if dataset.chosen else []),
        *([f"left out    {left_out_text(dataset.left_out)}"] if dataset.left_out else []),
        f"image       {width} x {height} px{mixed}",
        f"camera      {camera}",
        *_place(dataset),
        *(_moves(dataset, motion) if motion.first.size else []),
        *_time(dataset, motion),
        *_jumps(dataset, motion),
        f"agreement   {_agreement_text(agreement)}",
        *(f"suspicious  {text}" for text in suspicions(motion, agreement)),
        *_sequences(dataset, motion),
    ]


def suspicions(motion: Motion, agreement: Agreement | None) -> list[str]:
    """Return what contradicts the poses' units, quaternion order, direction or axes."""
    found = []
    if agreement is not None and agreement.better is not None:
        found.append(
            f"the poses look like {agreement.better}: {agreement.fits[agreement.better]:.0%} of "
            f"tracked points fit that, {agreement.fits[READ]:.0%} the poses as read"
        )
    elif agreement is not None and agreement.poor:
        found.append(
            "images and poses do not belong together: check the stamps or numbers that join them, "
            "the intrinsics and the axes of the poses"
        )
    far = agreement is not None and agreement.depth is not None and agreement.depth > _FARTHEST_M
    fast = motion.seconds is not None and _median(motion.rates(motion.metres)) > _FASTEST
    reasons = []
    if far and agreement is not None:
        reasons.append(f"what the camera sees is {agreement.depth:.0f} m away")
    if fast:
        reasons.append(f"the camera moves at {_median(motion.rates(motion.metres)):.0f} m/s")
    if reasons:
        found.append(f"positions look like millimetres, not metres: {' and '.join(reasons)}")
    return found


def _place(dataset: PoseDataset) -> list[str]:
    position_m = dataset.poses[:, :3]
    low, high = position_m.min(axis=0), position_m.max(axis=0)
    extent = zip("xyz", low, high, strict=True)
    lines = [
        "positions   " + ", ".join(f"{axis} {a:.2f} .. {b:.2f}" for axis, a, b in extent) + " m"
    ]
    if dataset.origin_m is not None:
        numbers = " ".join(f"{value:.0f}" for value in dataset.origin_m)
        lines.append(f"origin      {numbers} m: networks learn positions about it, bundles keep it")
    return lines


def _moves(dataset: PoseDataset, motion: Motion) -> list[str]:
    per = "s" if motion.seconds is not None else "frame"
    extent = " x ".join(f"{size:.2f}" for size in np.ptp(dataset.poses[:, :3], axis=0))
    speed, turn = motion.rates(motion.metres), np.rad2deg(motion.rates(motion.radians))
    wide = ""
    if motion.spread_rad > MAX_SPREAD_RAD:
        wide = (
            f": more than {MAX_SPREAD_RAD:g}, networks learn nine numbers instead of six, and "
            "baselines cannot be trained"
        )
    names = [name for name, rests in zip(get_args(StillDof), motion.still, strict=True) if rests]
    told = "learned with a floor as unit, scores leave them out"
    if motion.still.all():
        told = "there is nothing to learn, and training refuses that"
    return [
        f"extent      {extent} m, path {motion.metres.sum():.1f} m",
        *(
            [f"speed       {_rates(speed)} m/{per}", f"rotation    {_rates(turn)} deg/{per}"]
            if speed.size
            else []
        ),
        f"turns       up to {motion.spread_rad:.2f} rad from the mean rotation{wide}",
        *([f"still       {' '.join(names)} hardly move: {told}"] if names else []),
        f"up          {_up_text(dataset.poses)}",
    ]


def _up_text(poses: Array) -> str:
    up = up_of(poses)
    axis = int(np.abs(up.direction).argmax())
    sign = "-" if up.direction[axis] < 0.0 else "+"
    off = np.rad2deg(np.arccos(min(1.0, float(np.abs(up.direction[axis])))))
    if off > 15.0:
        text = "(" + " ".join(f"{value:.2f}" for value in up.direction) + "), along no axis"
    else:
        text = f"{sign}{'xyz'[axis]}, {off:.0f} deg off"
    return f"{text}, judged from level cameras" + (f"; not sure: {up.doubt}" if up.doubt else "")


def _time(dataset: PoseDataset, motion: Motion) -> list[str]:
    if dataset.stamps_ns is None or motion.seconds is None:
        return ["time        no stamps: rates are per frame, gaps cannot be seen"]
    passed = motion.seconds[~motion.repeated]
    if not passed.size:
        return ["time        one stamp only"]
    starts = np.flatnonzero(np.diff(dataset.sequence, prepend=-1))
    ends = np.append(starts[1:], len(dataset)) - 1
    span = float(((dataset.stamps_ns[ends] - dataset.stamps_ns[starts]) / 1e9).sum())
    text = f"{span:.1f} s at {1.0 / float(np.median(passed)):.1f} Hz"
    gaps = np.flatnonzero(motion.gaps)
    if gaps.size:
        longest = gaps[motion.seconds[gaps].argmax()]
        name = dataset.frame_names[motion.first[longest]]
        text += (
            f"; {_counted(gaps.size, 'gap')}, the longest of {motion.seconds[longest]:.2f} s "
            f"after {name}"
        )
    if motion.repeated.any():
        text += f"; {_counted(int(motion.repeated.sum()), 'stamp')} repeated"
    return [f"time        {text}"]


def _jumps(dataset: PoseDataset, motion: Motion) -> list[str]:
    jumps = np.flatnonzero(motion.jumps)
    named = [
        f"{motion.metres[step]:.2f} m and {np.rad2deg(motion.radians[step]):.0f} deg after "
        f"{dataset.frame_names[motion.first[step]]}"
        for step in jumps[:_NAMED]
    ]
    more = f", and {jumps.size - _NAMED} more" if jumps.size > _NAMED else ""
    return [f"jumps       {', '.join(named)}{more}"] if named else []


def _agreement_text(agreement: Agreement | None) -> str:
    if agreement is None:
        return "not compared with the poses: too few points can be followed from frame to frame"
    depth = "" if agreement.depth is None else f", seen from {agreement.depth:.2g} m (median)"
    return (
        f"{agreement.fits[READ]:.0%} of tracked points fit the poses, in "
        f"{_counted(agreement.pairs, 'pair')} of frames{depth}"
    )


def _sequences(dataset: PoseDataset, motion: Motion) -> list[str]:
    number = len(dataset.sequence_names)
    counts = np.bincount(dataset.sequence, minlength=number)
    paths = np.bincount(dataset.sequence[motion.first], motion.metres, minlength=number)
    return [
        f"sequence    {name}: {_counted(count, 'frame')}, path {path:.1f} m"
        for name, count, path in zip(dataset.sequence_names, counts, paths, strict=True)
    ]


def _rates(values: Array) -> str:
    return f"median {np.median(values):.3g}, largest {values.max():.3g}"


def _median(values: Array) -> float:
    return float(np.median(values)) if values.size else 0.0


def _counted(count: int, word: str) -> str:
    return f"{count} {word}{'' if count == 1 else 's'}"
