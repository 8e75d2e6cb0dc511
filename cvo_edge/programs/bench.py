"""Benchmark of a bundle on this machine, compared with the bare inference call in the same run."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain, islice
from pathlib import Path
from time import perf_counter, process_time
from typing import Any

import numpy as np

from cvo_edge.bundle.format import Calibration
from cvo_edge.engine.model_cache import ModelCache
from cvo_edge.engine.session import Session
from cvo_edge.errors import SourceError, UsageError
from cvo_edge.estimate import PoseInterval
from cvo_edge.input import preprocess
from cvo_edge.input.capture import shown
from cvo_edge.input.frame import Frame
from cvo_edge.input.half import halve
from cvo_edge.input.pipes import names_pipe
from cvo_edge.input.sources import names_camera, open_source
from cvo_edge.odometer import Odometer
from cvo_edge.programs.measure import (
    LatencyProfile,
    environment,
    memory_mib,
    quantiles,
    waited_for_cores_s,
)
from cvo_edge.scheduling import AHEAD
from cvo_edge.vocabulary import Scope

# Frame size and rate of a common camera, used if no source is given.
_DEFAULT_HEIGHT, _DEFAULT_WIDTH = 480, 640
_LIVE_FPS = 30
# How often a stream and bare calls alternate.
_ROUNDS = 5


@dataclass
class _Found:
    """Measurements of the timed frames, with one ratio per step or per round of a stream."""

    raw_ms: list[float] = field(default_factory=list)
    ratios: list[float] = field(default_factory=list)
    latency: LatencyProfile = field(default_factory=LatencyProfile)
    valid: int = 0
    in_alarm: int = 0
    dropped: int = 0
    wall_s: float = 0.0
    cpu_s: float = 0.0
    # From the first to the last frame, including the bare calls.
    all_s: float = 0.0
    waited_s: float | None = None

    def share_waited(self, threads: int) -> float | None:
        """Return the share of the time of so many threads that was waited for a core."""
        return None if self.waited_s is None else round(self.waited_s / (threads * self.all_s), 4)


def benchmark(
    bundle: Path,
    source: str | None = None,
    *,
    frames: int = 200,
    warmup: int = 20,
    mode: str = "latency",
    threads: int | None = None,
    confidence: float = 0.9,
    scope: Scope = "marginal",
    cache: ModelCache | None = None,
    stages: bool = False,
) -> dict[str, Any]:
    """Time ``frames`` frames in a mode, and as many bare inference calls on the same model.

    The two alternate, so that changes of the machine's speed affect both: in mode ``latency`` one
    step and one call, in other modes a fifth of the frames as a stream and as many calls.
    ``ratio_to_raw`` is the median ratio of a frame's time to that of a call. A frame's time is the
    step without reading in ``latency``, the time per frame in ``throughput``, and the age of a
    frame at its interval in ``live``. Files are read repeatedly, in ``live`` at 30 frames per
    second. Without a source, the benchmark uses a synthetic still image; if its pose is
    implausible, the conformal step is not run. ``frames_valid`` counts frames with a plausible
    pose, ``frames_in_alarm`` those during an alarm. Invalid frames of a source are not timed.
    ``stages`` measures the stages of as many frames afterwards, see ``cvo_edge.programs.stages``.
    Returns the report of ``cvo-edge bench --json``.

    Raises UsageError for invalid counts, SourceError if the source gives no valid frame, and the
    errors of ``Odometer.load``.
    """
    if frames < 1 or warmup < 0:
        raise UsageError(
            f"bench: expected frames >= 1 and warmup >= 0, found {frames} and {warmup}"
        )
    start = perf_counter()
    with Odometer.load(
        bundle, threads=threads, mode=mode, confidence=confidence, scope=scope, cache=cache
    ) as odometer:
        load_ms = 1e3 * (perf_counter() - start)
        stream = _Endless(source, _still_size(odometer.calibration), threads)
        if odometer.calibration.preprocess.decode == "half":
            stream.halve()
        report = _measured(odometer, source, stream, frames, warmup, load_ms)
        if stages:
            from cvo_edge.programs.stages import measure

            report["stages"] = measure(odometer, stream, frames, warmup)
    return report


def _measured(
    odometer: Odometer,
    source: str | None,
    stream: _Endless,
    frames: int,
    warmup: int,
    load_ms: float,
) -> dict[str, Any]:
    session = odometer.session
    if session is None:  # pragma: no cover - just loaded
        raise UsageError("bench: expected an open odometer")
    calibration = odometer.calibration
    first = next(iter(stream))
    odometer.step(first.image)
    first_interval_ms = _process_age_ms()
    measure = _steps if odometer.mode == "latency" else _streams
    found = measure(odometer, session, stream, frames, warmup)
    if not found.latency.count:
        raise SourceError(f"{shown(source or 'image')}: none of {frames} frames is valid")
    counted = found.latency.count
    return {
        "bundle": calibration.name,
        "bundle_digest": calibration.digest,
        "method": calibration.method,
        "precision": calibration.model.precision,
        "provider": calibration.model.provider,
        "source": None if source is None else _name(source),
        "mode": odometer.mode,
        "frames": frames,
        "frames_valid": found.valid,
        "frames_in_alarm": found.in_alarm,
        "frames_skipped": found.dropped,
        "warmup": warmup,
        "latency_ms": found.latency.summary(),
        "raw_model_ms": quantiles(found.raw_ms),
        "ratio_to_raw": {"median": round(float(np.median(found.ratios)), 4)},
        "throughput_fps": round(counted / found.wall_s, 3),
        "load_ms": round(load_ms, 1),
        "first_interval_ms": first_interval_ms,
        "cpu_ms_per_frame": round(1e3 * found.cpu_s / counted, 3),
        "waited_for_cores": found.share_waited(odometer.threads),
        "memory_mib": memory_mib(),
        "environment": environment(odometer.threads),
    }


def _name(source: str) -> str:
    """Return a source's name, the same for every way to write its path."""
    return shown(source if "://" in source else os.path.normpath(source))


def _steps(
    odometer: Odometer, session: Session, stream: _Endless, frames: int, warmup: int
) -> _Found:
    """Alternate single steps with bare calls on the same image."""
    found = _Found()
    spec = odometer.calibration.preprocess
    feeds = _blank_feeds(odometer)
    all_begin, waited_s = perf_counter(), waited_for_cores_s()
    for count, frame in enumerate(islice(stream, warmup + frames)):
        image = preprocess.to_bgr8(frame.image)
        if image is not None:
            feeds["image"] = preprocess.model_input(image, spec.height, spec.width, spec.crop)
        raw_ms = _raw_ms(session, feeds) if count % 2 else 0.0
        cpu_begin, begin = process_time(), perf_counter()
        estimate = odometer.step(frame.image, frame.stamp_ns, frame.source, frame.read_ms)
        spent_s, cpu_s = perf_counter() - begin, process_time() - cpu_begin
        if not count % 2:  # the second of the two benefits from warmer caches
            raw_ms = _raw_ms(session, feeds)
        if count >= warmup and _counts(estimate, stream):
            found.valid += estimate.pose is not None
            found.in_alarm += estimate.drift.state == "alarm"
            found.latency.add(estimate.latency_ms)
            found.raw_ms.append(raw_ms)
            found.ratios.append(1e3 * spent_s / raw_ms)
            found.wall_s += spent_s + 1e-3 * frame.read_ms
            found.cpu_s += cpu_s
    found.all_s = perf_counter() - all_begin
    found.waited_s = _since(waited_s)
    return found


def _streams(
    odometer: Odometer, session: Session, stream: _Endless, frames: int, warmup: int
) -> _Found:
    """Alternate parts of a stream with as many bare calls."""
    found = _Found()
    feeds = _blank_feeds(odometer)
    live = odometer.mode == "live"
    with closing(odometer.stream(stream)) as estimates:
        for _ in islice(estimates, warmup):
            pass
        all_begin, waited_s = perf_counter(), waited_for_cores_s()
        for part in np.array_split(np.arange(frames), min(_ROUNDS, frames)):
            # Skip estimates that were computed while bare calls were timed.
            lying = islice(estimates, odometer.threads + AHEAD)
            before = [estimate.seq for estimate in lying][-1]
            ages_ms = []
            cpu_begin, begin = process_time(), perf_counter()
            for estimate in islice(estimates, len(part)):
                found.dropped += estimate.seq - before - 1
                before = estimate.seq
                if _counts(estimate, stream):
                    found.valid += estimate.pose is not None
                    found.in_alarm += estimate.drift.state == "alarm"
                    found.latency.add(estimate.latency_ms)
                    ages_ms.append(estimate.latency_ms["total"])
            spent_s, cpu_s = perf_counter() - begin, process_time() - cpu_begin
            raw_ms = [_raw_ms(session, feeds) for _ in part]
            found.raw_ms += raw_ms
            found.wall_s += spent_s
            found.cpu_s += cpu_s
            if ages_ms:
                whole_ms = float(np.median(ages_ms)) if live else 1e3 * spent_s / len(ages_ms)
                found.ratios.append(whole_ms / float(np.median(raw_ms)))
        # Read before the stream ends, while its worker threads still exist.
        found.all_s = perf_counter() - all_begin
        found.waited_s = _since(waited_s)
    return found


def _counts(estimate: PoseInterval, stream: _Endless) -> bool:
    """Whether to time a frame: invalid frames of a real source are fast and would bias results."""
    return stream.still or estimate.pose is not None


def _blank_feeds(odometer: Odometer) -> dict[str, Any]:
    spec = odometer.calibration.preprocess
    image = np.zeros((1, spec.height, spec.width, 3), np.uint8)
    return {"image": image, **odometer.head.extra_inputs(0)}


def _raw_ms(session: Session, feeds: dict[str, Any]) -> float:
    begin = perf_counter()
    session.run(feeds)
    return 1e3 * (perf_counter() - begin)


def _since(waited_s: float | None) -> float | None:
    now_s = waited_for_cores_s()
    return None if now_s is None or waited_s is None else now_s - waited_s


class _Endless:
    """A source repeated endlessly; without a source, a still image."""

    length: int | None = None

    def __init__(
        self, source: str | None, size: tuple[int, int], threads: int | None = None
    ) -> None:
        self.still, self._size = source is None, size
        self._source, self._threads = source, threads
        self._half = False
        self.live = source is not None and names_camera(source)
        # One iterator for all callers, because many cameras serve a single client only.
        self._numbered = enumerate(self._again())

    def halve(self) -> None:
        """Decode at half size."""
        self._half = True

    def reads(self) -> Iterator[Callable[[], Frame]]:
        """Yield a call per frame; frames of files get the stamps of a camera at a constant rate."""
        for seq, read in self._numbered:
            yield read if self.live else partial(_stamped, read, round(seq * 1e9 / _LIVE_FPS))

    def __iter__(self) -> Iterator[Frame]:
        """Yield the frames."""
        for read in self.reads():
            yield read()

    def _again(self) -> Iterator[Callable[[], Frame]]:
        if self._source is None:
            still = Frame(preprocess.selftest_image(*self._size), None, "", 0.0)
            while True:
                yield lambda: still
        while True:
            frames = open_source(self._source, threads=self._threads)
            if self._half:
                halve(frames)
            reads = frames.reads()
            first = next(reads, None)
            if first is None:
                raise SourceError(f"{shown(self._source)}: the source has no frames")
            yield from chain([first], reads)
            if names_pipe(self._source):
                raise SourceError(
                    f"{shown(self._source)}: expected as many frames as are timed, found the end "
                    "of the pipe; use a file, which is read again, or fewer --frames"
                )


def _still_size(calibration: Calibration) -> tuple[int, int]:
    """Return height and width of an image of the shape that the bundle expects, 640 wide."""
    images = calibration.images
    if images is None:
        return _DEFAULT_HEIGHT, _DEFAULT_WIDTH
    if calibration.preprocess.decode == "half":
        return images.height // 2, images.width // 2
    width = max(_DEFAULT_WIDTH, calibration.preprocess.width)
    return round(width * images.height / images.width), width


def _stamped(read: Callable[[], Frame], stamp_ns: int) -> Frame:
    return replace(read(), stamp_ns=stamp_ns)


def _process_age_ms() -> float | None:
    """Return the milliseconds since this process started, None if the kernel does not tell."""
    try:
        fields = Path("/proc/self/stat").read_text().rpartition(")")[2].split()
        uptime = time.clock_gettime(time.CLOCK_BOOTTIME)
        return round(1e3 * (uptime - int(fields[19]) / os.sysconf("SC_CLK_TCK")), 1)
    except (OSError, AttributeError, ValueError):
        return None
