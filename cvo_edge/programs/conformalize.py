"""What ``conformalize`` does: read, compare, calibrate, write, report; here or on a cluster."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any, NamedTuple

from cvo_edge.files import write_text
from cvo_edge.motion.conformalize import conformalize
from cvo_edge.motion.corrections import Fit
from cvo_edge.motion.format import MotionFile, encode_motion_file
from cvo_edge.motion.horizons import Horizon
from cvo_edge.programs.motion_report import calibration_lines, fit_lines
from cvo_edge.programs.progress import items_progress
from cvo_edge.programs.trajectories import Files, Reading, correct_pairs, fits, read_pairs
from cvo_edge.spread import Here, OnRay, Spread
from cvo_edge.vocabulary import MotionCorrection, MotionEngine


class Wanted(NamedTuple):
    """What to calibrate, see ``motion.conformalize``, and what to correct before."""

    name: str
    horizons: Sequence[Horizon] | None
    windows: Sequence[Horizon] | None
    learned: bool
    columns: Sequence[str]
    corrections: Sequence[MotionCorrection]


class Learned(NamedTuple):
    """What was calibrated, and what was found of the pairs' alignment and drives."""

    file: MotionFile
    fits: list[Fit]
    notes: list[str]


def calibrate(
    files: Sequence[Files], reading: Reading, wanted: Wanted, output: str, engine: MotionEngine
) -> None:
    """Write ``motion.json`` and print the report."""
    with _spread(engine) as spread:
        file, fitted, notes = learn(files, reading, wanted, spread)
    content = encode_motion_file(file)
    # Before the report: whoever reads that may close the pipe.
    write_text(output, content.decode())
    if output != "-":
        print(*fit_lines(fitted, wanted.corrections), *notes, sep="\n")
        print(*calibration_lines(file), sep="\n")
        print(f"-> {output}, {len(content)} bytes")


def learn(
    files: Sequence[Files],
    reading: Reading,
    wanted: Wanted,
    spread: Callable[[Sequence[Files]], Spread[Any]],
) -> Learned:
    """Read and calibrate pairs where ``spread`` puts them."""
    pairs, notes = read_pairs(files, reading, spread)
    fitted = fits(pairs)
    corrected, correction = correct_pairs(pairs, fitted, wanted.corrections)
    # Pairs are let go once their rows are known, if nobody else keeps them.
    only = [corrected]
    del pairs, corrected
    file = conformalize(
        only.pop(),
        wanted.name,
        wanted.horizons,
        wanted.windows,
        learned=wanted.learned,
        columns=wanted.columns,
        correction=correction,
    )
    return Learned(file, fitted, notes)


@contextmanager
def _spread(engine: MotionEngine) -> Iterator[Callable[[Sequence[Files]], Spread[Any]]]:
    with items_progress() as watch:
        if engine == "local":
            yield partial(Here, watch=watch)
            return
        from cvo_edge.cluster import ray_cluster

        with ray_cluster("conformalize", "cvo-edge") as ray:
            yield partial(OnRay.of, ray, watch=watch)
