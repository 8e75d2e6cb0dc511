"""The command ``drift``: whether recordings are still exchangeable with the calibration's."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from msgspec import UNSET, Struct

from cvo_edge.bundle.format import Calibration
from cvo_edge.bundle.reading import read_calibration
from cvo_edge.errors import (
    BundleMismatchError,
    CalibrationFileError,
    SourceError,
    UsageError,
    printable,
)
from cvo_edge.monitor.martingale import ALARM, RecordingMartingale, mean_novelty
from cvo_edge.output.records import Header, read_records


class Recording(Struct, frozen=True):
    """One file of records: frames, those judged by the alarm, and what they come to.

    Without a judged frame, the last four are None or as before: nothing was bet on it.
    """

    file: str
    frames: int
    judged: int
    novelty: float | None
    p: float | None
    martingale: float
    alarm: bool


class DriftReport(Struct, frozen=True):
    """All recordings in the order given, and what they were compared with.

    ``crossed``: other networks judged the calibration's recordings, so that nothing is proven.
    """

    bundle: str
    digest: str
    calibration_recordings: int
    crossed: bool
    alarm_at: float
    recordings: tuple[Recording, ...]

    @property
    def largest(self) -> float:
        """The largest capital, at least 1."""
        return max((1.0, *(each.martingale for each in self.recordings)))


def drift_of(bundle: str | Path, files: Sequence[str | Path]) -> DriftReport:
    """Compare recordings (files of JSON Lines) with those that the bundle was calibrated on.

    Raises
    ------
    CalibrationFileError
        The bundle cannot be read, or has no calibration recordings to compare with.
    BundleMismatchError
        Records of another bundle.
    SourceError
        A file cannot be read, or does not say of which bundle its records are; or no file has a
        frame that the alarm judged.
    UsageError
        A recording is given twice: it would count as two.
    """
    calibration = read_calibration(bundle)
    reference = _reference(calibration)
    martingale = RecordingMartingale(reference)
    recordings, capital, alarm = [], 1.0, False
    known: dict[tuple[float | None, ...], str | Path] = {}
    for file in files:
        novelties = tuple(_novelties(file, calibration))
        if novelties in known and any(novelties):
            raise UsageError(
                "drift: expected each recording once, found that of "
                f"{printable(str(known[novelties]))} again in {printable(str(file))}"
            )
        known[novelties] = file
        judged, novelty = mean_novelty(novelties)
        p = None
        if novelty is not None:
            p, capital, alarm = martingale.add(novelty)
        recordings.append(Recording(str(file), len(novelties), judged, novelty, p, capital, alarm))
    if not any(each.judged for each in recordings):
        raise SourceError(
            f"drift: expected frames that the alarm judged, found none in {len(files)} recordings; "
            "see their reasons"
        )
    return DriftReport(
        calibration.name,
        calibration.digest,
        len(reference),
        calibration.calibration.crossed is not None,
        ALARM,
        tuple(recordings),
    )


def _reference(calibration: Calibration) -> tuple[float, ...]:
    alarm = calibration.alarm
    if alarm is not None and alarm.recordings is not None:
        return alarm.recordings
    if alarm is None:
        found = "a bundle without an alarm"
    elif alarm.kind == "frames":
        found = "an alarm of single frames"
    else:
        found = "an alarm of a single recording or of an earlier release"
    raise CalibrationFileError(
        f"{calibration.name}: expected the novelty of each calibration recording "
        f"(alarm.recordings), found {found}; publish a run with a split by sequence"
    )


def _novelties(file: str | Path, calibration: Calibration) -> Iterator[float | None]:
    """Yield the novelty of each frame, None if it was not judged."""
    records = read_records(file)
    checked = _checked(records.header, file, calibration)
    for record in records:
        if records.header is not checked:
            checked = _checked(records.header, file, calibration)
        yield None if record.novelty is UNSET else record.novelty


def _checked(header: Header | None, file: str | Path, calibration: Calibration) -> Header:
    name = printable(str(file))
    if header is None:
        raise SourceError(f"{name}: expected a header that names the bundle, found none")
    if header.digest != calibration.digest:
        raise BundleMismatchError(
            f"{name}: expected records of {calibration.name} ({calibration.digest[:16]}), found "
            f"records of {printable(header.bundle)} ({printable(header.digest[:16])})"
        )
    return header


def drift_lines(report: DriftReport) -> list[str]:
    """Return the report as lines of readable text."""
    lines = [
        f"compared with {report.calibration_recordings} calibration recordings of {report.bundle}",
        f"{'frames':>8}{'judged':>8}{'novelty':>9}{'p':>8}{'martingale':>12}  recording",
    ]
    for each in report.recordings:
        novelty = "-" if each.novelty is None else f"{each.novelty:.4f}"
        p = "-" if each.p is None else f"{each.p:.4f}"
        lines.append(
            f"{each.frames:>8}{each.judged:>8}{novelty:>9}{p:>8}{each.martingale:>12.4g}  "
            f"{printable(each.file)}{'  alarm' if each.alarm else ''}"
        )
    first = next((each for each in report.recordings if each.alarm), None)
    if first is None:
        passed = sum(not each.judged for each in report.recordings)
        over = f"; {passed} recordings without a judged frame count for nothing" if passed else ""
        return [*lines, f"clear: the martingale stayed below {report.alarm_at:g}{over}"]
    return [
        *lines,
        f"alarm: the martingale reached {report.alarm_at:g} at {printable(first.file)}; "
        + _proven(report),
    ]


def _proven(report: DriftReport) -> str:
    if report.crossed:
        return "nothing is proven of how often it does so falsely: the calibration is crossed"
    return (
        "if all recordings are exchangeable with the calibrated ones, it ever does so with "
        f"probability at most {1.0 / report.alarm_at:g}"
    )
