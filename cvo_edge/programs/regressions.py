"""A report of ``bench`` beside an earlier one: what differs, and what became slower."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import msgspec
from msgspec import UNSET, Meta, Struct, UnsetType

from cvo_edge.documents import one_line, shown
from cvo_edge.errors import (
    BundleMismatchError,
    GateError,
    SourceError,
    UsageError,
    printable,
)
from cvo_edge.files import read_regular_file
from cvo_edge.programs.bench_report import TIMED

_MOST_BYTES = 1 << 20
TOLERANCE = 0.15
# Machines change their speed from second to second, which ratios within one run do not show.
_TIMES = 2.0

Positive = Annotated[float, Meta(gt=0.0)]
NotNegative = Annotated[float, Meta(ge=0.0)]


class Quantiles(Struct):
    """Those that are compared, ms."""

    p50: NotNegative
    p95: NotNegative


class BareCall(Struct):
    """Of the bare inference call, ms."""

    p50: Positive


class Latencies(Struct):
    """By stage."""

    read: Quantiles
    preprocess: Quantiles
    model: Quantiles
    conformal: Quantiles
    total: Quantiles


class Median(Struct):
    """A median."""

    median: Positive


class Turns(Struct):
    """A mode beside the script."""

    over_script: Median


class AgainstScript(Struct):
    """Modes beside the script."""

    latency: Turns
    throughput: Turns


class Memory(Struct):
    """MiB."""

    peak_rss: Positive


class Machine(Struct):
    """What decides the speed."""

    cpu: str
    threads: int
    versions: dict[str, str]


class Report(Struct, kw_only=True):
    """What is compared of a report; it has more keys."""

    software: str
    bundle: str
    bundle_digest: str
    source: str | None
    mode: str
    provider: str
    environment: Machine
    ratio_to_raw: Median
    raw_model_ms: BareCall
    latency_ms: Latencies
    throughput_fps: Positive
    cpu_ms_per_frame: NotNegative
    load_ms: NotNegative
    memory_mib: Memory
    against_script: AgainstScript | UnsetType = UNSET


class Figure(NamedTuple):
    """One figure of both reports; ``regression`` is None if its change is only shown."""

    name: str
    old: float
    new: float
    regression: bool | None

    @property
    def ratio(self) -> float:
        """How many times the old one the new one is; 1 if neither can be told."""
        return self.new / self.old if self.old > 0.0 else 1.0


class Comparison(NamedTuple):
    """Differences that make reports incomparable, and all figures that both have."""

    earlier: str
    tolerance: float
    differences: list[str]
    figures: list[Figure]

    def as_report(self) -> dict[str, Any]:
        """Return it for JSON."""
        figures = [{**each._asdict(), "ratio": round(each.ratio, 4)} for each in self.figures]
        return {**self._asdict(), "figures": figures}


def read_report(path: Path) -> Report:
    """Read an earlier report of ``bench --json``; raises SourceError for anything else."""
    content = read_regular_file(path, _MOST_BYTES, SourceError, links=True)
    try:
        report = msgspec.json.decode(content, type=Report)
        if not report.software.startswith("cvo-edge "):
            raise msgspec.ValidationError(f"software is {shown(report.software)}")
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise SourceError(
            f"{path}: expected a report of this version's bench --json, found another file: "
            f"{one_line(str(error))}; measure again with bench --json"
        ) from None
    return report


def checked_tolerance(tolerance: float) -> float:
    """Return it; raises UsageError unless it is from 0 to 10."""
    if not 0.0 <= tolerance <= 10.0:
        raise UsageError(f"--tolerance: expected 0 to 10, found {tolerance:g}")
    return tolerance


def compared(earlier: str, old: Report, report: dict[str, Any], tolerance: float) -> Comparison:
    """Compare a report with an earlier one.

    A figure is a regression if it grew by more than the tolerance, times in ms by more than twice
    as much.
    """
    new = msgspec.convert({"software": old.software, **report}, Report)
    before, now = _figures(old), _figures(new)
    figures = []
    for name, (value, allowed) in now.items():
        if name in before:
            old_value = before[name][0]
            limit = None if allowed is None else old_value * (1.0 + allowed * tolerance)
            figures.append(Figure(name, old_value, value, None if limit is None else value > limit))
    return Comparison(earlier, tolerance, list(_differences(old, new)), figures)


def _differences(old: Report, new: Report) -> Iterator[str]:
    """Yield what makes figures incomparable."""
    versions = [each.environment.versions.get(each.provider, "none") for each in (old, new)]
    pairs = {
        "bundle": (f"{old.bundle} {old.bundle_digest}", f"{new.bundle} {new.bundle_digest}"),
        "mode": (old.mode, new.mode),
        "source": (old.source or "none", new.source or "none"),
        "cpu": (old.environment.cpu, new.environment.cpu),
        "threads": (str(old.environment.threads), str(new.environment.threads)),
        new.provider: (versions[0], versions[1]),
    }
    for name, (before, now) in pairs.items():
        if before != now:
            # The earlier report is another's file.
            yield printable(f"{name} {before}, now {now}")


def _figures(report: Report) -> dict[str, tuple[float, float | None]]:
    """Return figures that are better if smaller, each with its share of the tolerance, or None."""
    raw_ms, latency = report.raw_model_ms.p50, report.latency_ms
    found: dict[str, tuple[float, float | None]] = {
        f"{TIMED.get(report.mode, 'time')} over the bare call": (report.ratio_to_raw.median, 1.0)
    }
    if report.against_script is not UNSET:
        for name in ("latency", "throughput"):
            turns: Turns = getattr(report.against_script, name)
            found[f"mode {name} over the script"] = turns.over_script.median, 1.0
    found["CPU time over the bare call"] = report.cpu_ms_per_frame / raw_ms, 1.0
    found["peak memory, MiB"] = report.memory_mib.peak_rss, 1.0
    found["bare call, ms"] = raw_ms, _TIMES
    found["total, ms"] = latency.total.p50, _TIMES
    found["time per frame, ms"] = 1e3 / report.throughput_fps, _TIMES
    for name in ("read", "preprocess", "model", "conformal"):
        found[f"{name}, ms"] = getattr(latency, name).p50, None
    found["total, p95, ms"] = latency.total.p95, None
    found["load, ms"] = report.load_ms, None
    return found


def comparison_lines(comparison: Comparison) -> Iterator[str]:
    """Yield the comparison as readable text."""
    tolerance = comparison.tolerance
    yield (
        f"beside {comparison.earlier}; regressions: ratios and memory beyond {tolerance:.0%}, "
        f"times beyond {_TIMES * tolerance:.0%}"
    )
    wide = 2 + max(len(each.name) for each in comparison.figures)
    yield f"{'':<{wide}}{'old':>10}{'new':>10}{'new/old':>9}"
    for each in comparison.figures:
        mark = "  regression" if each.regression else ""
        yield f"{each.name:<{wide}}{each.old:>10.3f}{each.new:>10.3f}{each.ratio:>9.3f}{mark}"
    for difference in comparison.differences:
        yield f"not comparable: {difference}"


def check(comparison: Comparison) -> None:
    """Raise BundleMismatchError for reports that are not comparable, GateError for a regression."""
    if comparison.differences:
        raise BundleMismatchError(
            f"bench: {comparison.earlier} is not comparable: {'; '.join(comparison.differences)}"
        )
    worse = [each for each in comparison.figures if each.regression]
    if worse:
        found = ", ".join(f"{each.name} {each.ratio:.2f} times" for each in worse)
        raise GateError(f"bench: expected no regression from {comparison.earlier}, found {found}")
