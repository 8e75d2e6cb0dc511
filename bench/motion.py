"""Intervals on the motion of public estimators, one drive left out at a time.

    python bench/motion.py [--sets kitti_lidar euroc_vio]

Trajectories come from ``CVO_DATA/trajectories``. KITTI has no times: 9.65 poses a second. EuRoC's
truths are moved by the time offset that ``conformalize`` finds. For each drive, thresholds are
learned on all others. Results: ``results/motion/SET.json``.

``width`` is the mean width over that of plain errors (``--scale none``); ``tolerance`` the share of
drives of which at least 90 % is inside, and the width over that of ``hierarchical``; ``hardest``
the coverage in the quarter of a drive's motions with the largest predicted scale. ``injected``:
what is found of a time offset, a turned body frame and a scale that were put in, beyond what is
found without. Times are processor time of this process. Memory is the peak of a process of its own,
which reads all files, beyond that of its imports; ``annotate`` of the longest drive.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from provenance import RESULTS, write_result

from cvo_edge import geometry
from cvo_edge.motion.adaptation import MotionAdaptation
from cvo_edge.motion.annotation import annotate
from cvo_edge.motion.audit import RecordingAudit, audit
from cvo_edge.motion.conformalize import conformalize
from cvo_edge.motion.corrections import fit_of
from cvo_edge.motion.format import MotionFile, encode_motion_file, read_motion_file
from cvo_edge.motion.intervals import Level, MotionCalibration, MotionWindow
from cvo_edge.motion.pairs import Pair
from cvo_edge.motion.recordings import trace_of
from cvo_edge.motion.relative import motion, norms, residual
from cvo_edge.motion.thresholds import Scores
from cvo_edge.motion.tracker import MotionTracker
from cvo_edge.motion.windows import window_errors
from cvo_edge.programs.measure import memory_mib
from cvo_edge.programs.trajectories import Files, Reading, correct_pairs, fits, read_pairs
from cvo_edge.spread import Here
from cvo_edge.vocabulary import MOTION_RULES, MotionCorrection

Array = NDArray[np.float64]

DATA = Path(os.environ.get("CVO_DATA", "data")) / "trajectories"
LEVEL = 0.9
# Seconds from a pose to its truth.
DELAYS_S = (0.0, 1.0, 10.0, 60.0)
LEAST_ONLINE = 100


def kitti() -> list[Pair]:
    """Return the pairs of KITTI 00 to 10."""
    folder = DATA / "kitti_lidar"
    files = [
        Files(path, folder / "groundtruth" / path.name)
        for path in sorted((folder / "estimate").glob("*.txt"))
    ]
    return read_pairs(files, Reading(fps=9.65)).pairs.collect()


def euroc() -> list[Pair]:
    """Return both runs of each EuRoC drive."""
    files = [
        Files(folder / f"estimate{run}.txt", folder / "groundtruth.txt")
        for folder in sorted((DATA / "euroc_vio").iterdir())
        for run in (0, 1)
    ]
    return read_pairs(files, Reading()).pairs.collect()


SETS: dict[str, tuple[Any, tuple[MotionCorrection, ...]]] = {
    "kitti_lidar": (kitti, ()),
    "euroc_vio": (euroc, ("time",)),
}


def alignments(pairs: Sequence[Pair]) -> list[dict[str, Any]]:
    """Return what the alignment report finds of each pair."""
    report = []
    for pair, fit in zip(pairs, fits(Here(pairs)), strict=True):
        found = fit.alignment
        report.append(
            {
                "name": pair.name,
                "offset_ms": 1e3 * found.offset_s,
                "offset_error_ms": 1e3 * found.offset_error_s,
                "rotation_deg": np.rad2deg(found.determined_rotation).tolist(),
                "undetermined": found.undetermined.tolist(),
                "scale": found.scale,
                "worth": [name for name, effect in fit.effects.items() if effect.worth],
            }
        )
    return report


def injected(pairs: Sequence[Pair]) -> dict[str, Any]:
    """Put faults into each pair; return the largest error of what is found, and what is named."""
    turn = geometry.quaternion_exp(np.deg2rad([0.0, 1.5, 0.0]))
    errors: dict[str, list[float]] = {}
    named: dict[str, list[bool]] = {}
    for pair in pairs:
        plain = pair.aligned()
        if plain is None:
            continue
        turned, larger = pair.estimate.copy(), pair.estimate.copy()
        turned[:, 3:] = geometry.quaternion_multiply(turned[:, 3:], turn)
        larger[:, :3] *= 1.02
        cases = {
            **{
                f"{ms} ms": replace(pair, stamps_ns=pair.stamps_ns + 1_000_000 * ms)
                for ms in (50, 100)
            },
            "1.5 deg": replace(pair, estimate=turned),
            "2 %": replace(pair, estimate=larger),
        }
        for name, case in cases.items():
            found = case.aligned()
            if found is None:
                continue
            fit = fit_of(case, found)
            if name.endswith("ms"):
                error = 1e3 * (found.offset_s - plain.offset_s) + float(name.split()[0])
                kind: MotionCorrection = "time"
            elif name == "1.5 deg":
                before, after = (geometry.quaternion_exp(each.rotation) for each in (plain, found))
                off = geometry.quaternion_log(
                    geometry.quaternion_multiply(geometry.quaternion_conjugate(before), after)
                )
                # Only about axes about which the rotation is determined.
                along = plain.axes[plain.rotation_error_deg <= 0.5]
                error = float(np.rad2deg(np.abs(along @ (off - np.deg2rad([0, 1.5, 0]))).max()))
                kind = "frame"
            else:
                error = 100.0 * (found.scale / plain.scale * 1.02 - 1.0)
                kind = "scale"
            errors.setdefault(name, []).append(abs(error))
            named.setdefault(name, []).append(fit.effects[kind].worth)
    return {
        name: {"largest_error": max(each), "named": sum(named[name]), "of": len(each)}
        for name, each in errors.items()
    }


def left_out(pairs: Sequence[Pair]) -> dict[str, Any]:
    """Learn on all drives but one, for each; return what holds on that one."""
    drives = sorted({pair.group for pair in pairs})
    found: dict[str, list[dict[str, Any]]] = {}
    audits: list[RecordingAudit] = []
    tubes: dict[str, list[Array]] = {}
    adapted: list[dict[str, Any]] = []
    for drive in drives:
        others = [pair for pair in pairs if pair.group != drive]
        own = [pair for pair in pairs if pair.group == drive]
        fitted, plain = (
            MotionCalibration(conformalize(Here(others), "bench", learned=learned))
            for learned in (True, False)
        )
        for index, horizon in enumerate(fitted.horizons):
            row = one_drive(fitted, plain, index, own)
            if row is not None:
                found.setdefault(horizon.spec.horizon, []).append(row)
        audits += audit(fitted, Level(LEVEL), own).recordings
        adapted += online(fitted, own)
        for window in fitted.windows:
            widths = (tube_widths(window, own, fitted), bands_of(window, others, fitted))
            tubes.setdefault(window.spec.window, []).append(np.array(widths))
    return {
        "horizons": [summary(name, rows) for name, rows in found.items()],
        "tubes": [tube(name, widths, audits) for name, widths in tubes.items()],
        "online": online_summary(adapted),
    }


def online(calibration: MotionCalibration, pairs: Sequence[Pair]) -> Iterator[dict[str, Any]]:
    """Yield coverage and width of thresholds that follow truths, by horizon and delay.

    Widths are over those of the best constant threshold of the drive itself.
    """
    for pair in pairs:
        rows, truth = trace_of(pair, calibration.limits, ()), pair.truth
        for horizon in calibration.horizons:
            found = horizon.intervals(rows, Level(LEVEL))
            off = residual(found.moved, motion(truth[found.start], truth[found.end])) - found.bias
            known = np.isfinite(off).all(axis=1)
            if known.sum() < LEAST_ONLINE:
                continue
            errors = np.concatenate([np.abs(off), norms(off)], axis=1)
            width = np.concatenate([0.5 * (found.upper - found.lower), found.radii], axis=1)
            scores, ends = (errors / width)[known], found.end[known]
            spans = (found.end - found.start)[known]
            best = np.quantile(scores, LEVEL, axis=0)
            for delay_s in DELAYS_S:
                late = round(delay_s / calibration.limits.period_s)
                adapting = MotionAdaptation(1.0 - LEVEL, joint=False)
                x = np.zeros_like(scores)
                for place in range(len(scores)):
                    x[place] = adapting.x
                    if (label := place - late) >= 0:
                        newest, span = int(ends[place]), int(spans[label])
                        adapting.update(int(ends[label]), newest, span, scores[label])
                factor = np.exp(x)
                yield {
                    "over": horizon.spec.horizon,
                    "delay_s": delay_s,
                    "inside": float((scores <= factor).mean()),
                    "width": float((factor.mean(axis=0) / best).mean()),
                    "widest": float((factor / best).max()),
                }


def online_summary(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return mean and worst drive for each horizon and delay."""
    found: dict[tuple[str, float], list[dict[str, Any]]] = {}
    for row in rows:
        found.setdefault((row["over"], row["delay_s"]), []).append(row)
    return [
        {
            "over": over,
            "delay_s": delay_s,
            "inside": float(np.mean([row["inside"] for row in each])),
            "worst": min(row["inside"] for row in each),
            "width": float(np.mean([row["width"] for row in each])),
            "widest": max(row["widest"] for row in each),
        }
        for (over, delay_s), each in found.items()
    ]


def bands_of(window: MotionWindow, pairs: Sequence[Pair], calibration: MotionCalibration) -> Array:
    """Return the mean over a window of the errors (8,) that 90 % of motions do not exceed."""
    places = np.linspace(0.04, 1.0, 25) * window.window.value
    parts = []
    for pair in pairs:
        rows = trace_of(pair, calibration.limits, ())
        parts.append(window_errors(rows, pair.truth, window.window))
    near = 0.5 * (places[1] - places[0])
    bands = []
    for place in places:
        errors = [each.errors[np.abs(each.along - place) <= near] for each in parts]
        used = [(each, pair.group) for each, pair in zip(errors, pairs, strict=True) if len(each)]
        scores = Scores([each for each, _ in used], [group for _, group in used])
        bands.append(scores.thresholds("mean", LEVEL))
    return np.asarray(np.mean(bands, axis=0))


def tube_widths(
    window: MotionWindow, pairs: Sequence[Pair], calibration: MotionCalibration
) -> Array:
    """Return the mean over windows of half-widths and radii (8,); NaN without windows."""
    found = []
    for pair in pairs:
        each = window_errors(trace_of(pair, calibration.limits, ()), pair.truth, window.window)
        if len(each.anchor):
            widths = window.after(each.along, each.numbers, Level(LEVEL))
            found.append((each.shares * widths).sum(axis=1) / (each.anchor[-1] + 1))
    return np.asarray(np.mean(found, axis=0)) if found else np.full(8, np.nan)


def tube(name: str, widths: list[Array], audits: Sequence[RecordingAudit]) -> dict[str, Any]:
    """Return the share of windows inside, and the mean width over bands of single times.

    Both are of position, of rotation, and of all six degrees of freedom at once.
    """
    whole = [each for one in audits for each in one.windows if each.window == name and each.windows]
    of_tubes, of_bands = np.nanmean(widths, axis=0)
    ratio = of_tubes / of_bands
    return {
        "window": name,
        "recordings": len(whole),
        "inside": np.mean([(w.position, w.rotation, w.six) for w in whole], axis=0).tolist(),
        "over_bands": [*ratio[6:].tolist(), float(ratio[:6].mean())],
    }


def one_drive(
    learned: MotionCalibration, plain: MotionCalibration, index: int, pairs: Sequence[Pair]
) -> dict[str, Any] | None:
    """Return coverage and widths of one drive at one horizon; None without motions."""
    row: dict[str, Any] = {}
    for rule in MOTION_RULES:
        inside, widths, scales = measured(learned, index, Level(LEVEL, rule), pairs)
        if not len(inside):
            return None
        row[rule] = {"coverage": inside.mean(axis=0), "width": widths.mean(axis=0)}
        if rule == "mean":
            hard = scales >= np.quantile(scales, 0.75, axis=0)
            row["hardest"] = (inside & hard).sum(axis=0) / hard.sum(axis=0)
    _, widths, _ = measured(plain, index, Level(LEVEL), pairs)
    row["plain"] = widths.mean(axis=0)
    return row


def measured(
    calibration: MotionCalibration, index: int, level: Level, pairs: Sequence[Pair]
) -> tuple[NDArray[np.bool_], Array, Array]:
    """Return whether each of (n, 8) errors is inside, its half-width or radius, and its scale."""
    parts = []
    for pair in pairs:
        rows = trace_of(pair, calibration.limits, ())
        found, truth = calibration.horizons[index].intervals(rows, level), pair.truth
        off = residual(found.moved, motion(truth[found.start], truth[found.end])) - found.bias
        errors = np.concatenate([np.abs(off), norms(off)], axis=1)
        width = np.concatenate([0.5 * (found.upper - found.lower), found.radii], axis=1)
        known = np.isfinite(errors).all(axis=1)
        parts.append((errors[known] <= width[known], width[known], found.scale[known]))
    inside, widths, scales = (np.concatenate(each) for each in zip(*parts, strict=True))
    return inside, widths, scales


def summary(name: str, rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Average over drives; pairs of numbers are those of position and rotation."""
    rules = {}
    hierarchical = np.mean([row["hierarchical"]["width"] for row in rows], axis=0)
    for rule in MOTION_RULES:
        coverage = np.array([row[rule]["coverage"] for row in rows])
        width = np.mean([row[rule]["width"] for row in rows], axis=0)
        rules[rule] = {
            "coverage_dof": float(coverage[:, :6].mean()),
            "coverage": coverage[:, 6:].mean(axis=0).tolist(),
            "least": float(coverage[:, :6].mean(axis=1).min()),
            "share": float((coverage >= LEVEL).mean()),
            "over_hierarchical": float(np.mean(width / hierarchical))
            if np.isfinite(hierarchical).all()
            else None,
            "width": width[6:].tolist(),
        }
    plain = np.mean([row["plain"] for row in rows], axis=0)
    mean = np.mean([row["mean"]["width"] for row in rows], axis=0)
    hardest = np.mean([row["hardest"] for row in rows], axis=0)
    return {
        "horizon": name,
        "drives": len(rows),
        "rules": rules,
        "over_plain_dof": float(np.mean(mean[:6] / plain[:6])),
        "over_plain": (mean[6:] / plain[6:]).tolist(),
        "hardest_dof": float(hardest[:6].mean()),
        "hardest": hardest[6:].tolist(),
    }


def peak_mib(step: str, name: str) -> float:
    """Return by how much memory grows at most, beyond imports, in a process of its own."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(_peak_mib, (step, name))


def _peak_mib(step: str, name: str) -> float:
    # What a calibration imports and allocates once is no part of its cost.
    before = memory_mib()["peak_rss"]
    pairs = SETS[name][0]()
    if step == "conformalize":
        conformalize(Here(pairs), "bench")
    else:
        calibration = MotionCalibration(read_motion_file(Path(step)))
        pair = max(pairs, key=lambda each: len(each.stamps_ns))
        for _ in annotate(calibration, Level(), pair.stamps_ns, pair.estimate, {}):
            pass
    return memory_mib()["peak_rss"] - before


def step_us(calibration: MotionCalibration, pair: Pair) -> float:
    """Return the median time of a step of the tracker over a drive, of this process alone."""
    tracker, times = MotionTracker(calibration), []
    for stamp_ns, pose in zip(pair.stamps_ns.tolist(), pair.estimate, strict=True):
        start = time.process_time_ns()
        tracker.step(stamp_ns, pose)
        times.append(time.process_time_ns() - start)
    return 1e-3 * float(np.median(times))


def costs(name: str, pairs: Sequence[Pair]) -> dict[str, Any]:
    """Return processor times, memory and the size of the file."""
    start = time.process_time()
    file: MotionFile = conformalize(Here(pairs), "bench")
    learned_s = time.process_time() - start
    calibration = MotionCalibration(file)
    start = time.process_time()
    count = sum(
        1
        for pair in pairs
        for _ in annotate(calibration, Level(), pair.stamps_ns, pair.estimate, {})
    )
    annotate_us = 1e6 * (time.process_time() - start) / count
    content = encode_motion_file(file)
    with tempfile.NamedTemporaryFile() as written:
        Path(written.name).write_bytes(content)
        annotate_mib = peak_mib(written.name, name)
    return {
        "poses": count,
        "conformalize_s": learned_s,
        "conformalize_mib": peak_mib("conformalize", name),
        "annotate_us": annotate_us,
        "annotate_mib": annotate_mib,
        "step_us": step_us(calibration, pairs[0]),
        "bytes": len(content),
    }


def main() -> None:
    """Measure the chosen sets."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sets", nargs="+", choices=SETS, default=list(SETS))
    for name in parser.parse_args().sets:
        read, wanted = SETS[name]
        pairs = read()
        here = Here(pairs)
        corrected = correct_pairs(here, fits(here), wanted)[0].collect()
        report = {
            "set": name,
            "corrected": list(wanted),
            "pairs": len(pairs),
            "drives": len({pair.group for pair in pairs}),
            "alignment": alignments(pairs),
            "injected": injected(corrected),
            **left_out(corrected),
            "costs": costs(name, corrected),
        }
        write_result(RESULTS / "motion" / f"{name}.json", report)


if __name__ == "__main__":
    main()
