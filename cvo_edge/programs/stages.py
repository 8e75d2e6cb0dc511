"""Where the time of a frame goes: a table of nested stages, from source to record.

Callables of the runtime are replaced by timed ones while the stages are measured, and only then, so
that it costs nothing otherwise.
"""

from __future__ import annotations

import inspect
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import partial, wraps
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import local
from time import perf_counter
from typing import Any, ParamSpec, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from cvo_edge.engine import observation
from cvo_edge.engine.observation import Observer
from cvo_edge.engine.session import Session
from cvo_edge.estimate import PoseInterval
from cvo_edge.input import image_files, preprocess
from cvo_edge.input.frame import Frame, Source
from cvo_edge.input.frame_checks import Look
from cvo_edge.input.half import halve
from cvo_edge.input.image_checks import KnownImages
from cvo_edge.input.repetition import Repetition
from cvo_edge.monitor.alarm import StreamAlarm
from cvo_edge.monitor.watch import StreamWatch
from cvo_edge.odometer import Odometer
from cvo_edge.output.lines import LineFile
from cvo_edge.output.records import header_of
from cvo_edge.output.sinks import Sink

P = ParamSpec("P")
T = TypeVar("T")
# Stages from the outermost to one's own.
Path_ = tuple[str, ...]

READ, ESTIMATE, CONCLUDE, WRITE = "read", "estimate", "conclude", "write"
# The outermost stages: each is called once per frame, in whatever thread.
ROOTS = (READ, ESTIMATE, CONCLUDE, WRITE)
ENGINE, REST = "engine", "rest"
# Records are kept in a file meanwhile.
MOST_FRAMES = 2000
_BAR = 40
_EMPTY_ROUNDS, _EMPTY_CALLS = 10, 200

# Names, the objects that hold them, and the stages that they are. A name is taken where it is
# looked up, which may be another module than that of its definition.
HOOKS: tuple[tuple[object, str, str], ...] = (
    (image_files, "read_regular_file", "file"),
    (image_files, "decode_image", "decode"),
    (Odometer, "_process", ESTIMATE),
    (preprocess, "viewed", "halve, resize"),
    (Look, "__init__", "statistics"),
    (observation, "image_doubt", "image checks"),
    (KnownImages, "doubt", "image checks"),
    (Repetition, "doubts", "repetition"),
    (Session, "run", ENGINE),
    (observation, "_output_fault", "output checks"),
    (Observer, "_checked", "output checks"),
    (Odometer, "conformal_set", "set"),
    (Odometer, "conclude", CONCLUDE),
    (StreamWatch, "judge", "stream checks"),
    (StreamWatch, "_camera_differs", "camera check"),
    (StreamAlarm, "judge", "alarm"),
    (Sink, "write", WRITE),
    (PoseInterval, "to_record", "record"),
    (msgspec.json, "encode", "JSON"),
    (LineFile, "write", "file"),
)


class Spans:
    """Seconds of nested calls, by thread.

    Attributes
    ----------
    found
        For each outermost stage one entry per call: seconds by stage, the stage itself included.
    """

    def __init__(self) -> None:
        self.found: dict[str, list[dict[Path_, float]]] = {root: [] for root in ROOTS}
        self._local = local()

    def timed(self, stage: str, call: Callable[P, T]) -> Callable[P, T]:
        """Return a call that is timed within an outermost stage, or is one."""
        root = stage in ROOTS
        here = self._local

        @wraps(call)
        def run(*args: P.args, **kwargs: P.kwargs) -> T:
            outer: Path_ = getattr(here, "path", ())
            if not (outer or root):
                return call(*args, **kwargs)
            if not outer:
                here.spent = defaultdict(float)
            here.path = path = (*outer, stage)
            begin = perf_counter()
            try:
                return call(*args, **kwargs)
            finally:
                here.spent[path] += perf_counter() - begin
                here.path = outer
                if not outer:
                    self.found[stage].append(here.spent)

        return run

    def read(self, read: Callable[[], Frame]) -> Frame:
        """Read a frame in the stage ``read``; other sources than files may have read it before."""
        frame = self.timed(READ, read)()
        spent = self._local.spent
        spent[READ,] = max(spent[READ,], 1e-3 * frame.read_ms)
        return frame


def timing_us() -> float:
    """Return what timing one call costs."""
    spans = Spans()
    nothing = spans.timed(REST, _nothing)

    def several() -> None:
        for _ in range(_EMPTY_CALLS):
            nothing()

    several = spans.timed(READ, several)
    for _ in range(_EMPTY_ROUNDS):
        several()
    return 1e6 * min(spent[READ,] for spent in spans.found[READ]) / _EMPTY_CALLS


def _nothing() -> None:
    pass


@contextmanager
def timing(spans: Spans, odometer: Odometer) -> Iterator[None]:
    """Time the stages of all odometers, and this one's solver, until the block ends."""
    hooks = list(HOOKS)
    observer = vars(odometer)["_observer"]
    if observer._solver is not None:  # noqa: SLF001 - the callable that it calls
        hooks.append((observer, "_solver", "solver"))
    kept = []
    try:
        for owner, name, stage in hooks:
            raw, call = inspect.getattr_static(owner, name), getattr(owner, name)
            timed: Any = spans.timed(stage, call)
            setattr(owner, name, staticmethod(timed) if isinstance(raw, classmethod) else timed)
            kept.append((owner, name, raw))
        yield
    finally:
        for owner, name, raw in kept:
            setattr(owner, name, raw)


class Timed:
    """A source whose reads are timed."""

    def __init__(self, source: Source, spans: Spans) -> None:
        self.length, self.live = source.length, source.live
        self._source, self._spans = source, spans

    def halve(self) -> None:
        """Decode at half size; raises UsageError if the source cannot."""
        halve(self._source)

    def reads(self) -> Iterator[Callable[[], Frame]]:
        """Yield a timed call for each frame."""
        return (partial(self._spans.read, read) for read in self._source.reads())

    def __iter__(self) -> Iterator[Frame]:
        """Yield the frames."""
        return (read() for read in self.reads())


@dataclass(frozen=True)
class Stage:
    """One row: a stage, or what its parts leave of it; microseconds per frame, share of a frame."""

    path: Path_
    mean_us: float
    p50_us: float
    p90_us: float
    share: float


def measure(odometer: Odometer, source: Source, frames: int, warmup: int) -> dict[str, Any]:
    """Return the stages of ``frames`` frames of a source, from reading to the record in a file.

    ``record_every_us`` is the time between two records, during which several threads may work.
    """
    frames = min(frames, MOST_FRAMES)
    spans, chart = Spans(), odometer.chart
    header = header_of(odometer.calibration, chart, odometer.confidence, odometer.scope)
    with (
        TemporaryDirectory(prefix="cvo-edge-bench-") as folder,
        Sink(str(Path(folder, "records.jsonl")), "jsonl", header) as sink,
        timing(spans, odometer),
        closing(odometer.stream(Timed(source, spans))) as estimates,
    ):
        for estimate in islice(estimates, warmup):
            sink.write(estimate)
        begin = perf_counter()
        for estimate in islice(estimates, frames):
            sink.write(estimate)
        every_us = 1e6 * (perf_counter() - begin) / frames
    rows = table({root: calls[warmup:] for root, calls in spans.found.items()})
    calls = sum(len(each) for found in spans.found.values() for each in found)
    return {
        "frames": frames,
        "record_every_us": round(every_us, 1),
        "timing_us": round(timing_us() * calls / (warmup + frames), 1),
        "rows": [_row(stage) for stage in rows],
    }


def _row(stage: Stage) -> dict[str, Any]:
    numbers = {"mean_us": stage.mean_us, "p50_us": stage.p50_us, "p90_us": stage.p90_us}
    return {
        "stage": "/".join(stage.path),
        **{name: round(value, 2) for name, value in numbers.items()},
        "share": round(stage.share, 5),
    }


def table(found: Mapping[str, list[dict[Path_, float]]]) -> list[Stage]:
    """Seconds by outermost stage, call and stage -> rows, each stage before its parts.

    Means of parts and rest add up to that of their stage, and shares to 1.
    """
    named = {root: _columns(calls) for root, calls in found.items() if calls}
    total_s = sum(float(columns[root,].mean()) for root, columns in named.items())
    return [
        Stage(
            path,
            1e6 * float(values.mean()),
            1e6 * float(np.percentile(values, 50)),
            1e6 * float(np.percentile(values, 90)),
            float(values.mean()) / total_s if total_s else 0.0,
        )
        for root, columns in named.items()
        for path, values in _with_rests(columns, (root,))
    ]


def _columns(calls: list[dict[Path_, float]]) -> dict[Path_, NDArray[np.float64]]:
    """Return the seconds of all calls by stage; a stage that a call did not have took none."""
    paths = dict.fromkeys(path for call in calls for path in call)
    return {path: np.array([call.get(path, 0.0) for call in calls]) for path in paths}


def _with_rests(
    columns: Mapping[Path_, NDArray[np.float64]], path: Path_
) -> Iterator[tuple[Path_, NDArray[np.float64]]]:
    """Yield a stage, its parts, theirs, and the rest."""
    yield path, columns[path]
    parts = [each for each in columns if each[:-1] == path]
    for part in parts:
        yield from _with_rests(columns, part)
    if parts:
        yield (*path, REST), columns[path] - sum(columns[part] for part in parts)


def stage_lines(found: Mapping[str, Any], mode: str) -> Iterator[str]:
    """Yield the table, with a bar for each stage at its place within the frame."""
    rows = found["rows"]
    total_us = sum(row["mean_us"] for row in rows if "/" not in row["stage"])
    engine_us = sum(row["mean_us"] for row in rows if row["stage"] == f"{ESTIMATE}/{ENGINE}")
    beside = " in several threads" if mode != "latency" else ""
    yield (
        f"stages, {found['frames']} frames: {total_us:.0f} us of work per frame{beside} "
        f"({engine_us:.0f} in the engine, {total_us - engine_us:.0f} around it), a record every "
        f"{found['record_every_us']:.0f} us"
    )
    yield f"{'us per frame':<22}{'mean':>9}{'p50':>9}{'p90':>9}{'share':>8}"
    for row, (begin, end) in zip(rows, places(rows), strict=True):
        *outer, name = row["stage"].split("/")
        first = min(round(_BAR * begin), _BAR - 1)
        bar = " " * first + "#" * max(1, round(_BAR * end) - first)
        yield (
            f"{'  ' * len(outer) + name:<22}{row['mean_us']:>9.1f}{row['p50_us']:>9.1f}"
            f"{row['p90_us']:>9.1f}{row['share']:>8.1%}  {bar}"
        )
    yield (
        "means and shares add up, medians need not; timing takes about "
        f"{found['timing_us']:.0f} us of each frame, mostly of rests"
    )


def places(rows: list[dict[str, Any]]) -> list[tuple[float, float]]:
    """Return where each row begins and ends within the frame, as shares of it."""
    ends: dict[int, float] = {-1: 0.0}
    found = []
    for row in rows:
        depth = row["stage"].count("/")
        begin = ends.get(depth, 0.0)
        found.append((begin, begin + row["share"]))
        # The next row of this depth begins at its end, and its own parts at its beginning.
        ends[depth], ends[depth + 1] = begin + row["share"], begin
    return found
