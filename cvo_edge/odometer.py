"""The loop: camera image -> observation -> conformal set -> PoseInterval."""

from __future__ import annotations

import os
from collections.abc import Generator, Iterable
from contextlib import closing
from operator import index
from pathlib import Path
from threading import Lock
from time import perf_counter
from types import TracebackType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cvo_edge.bundle.format import Calibration, Threshold
from cvo_edge.engine.loading import Bundle, read_bundle
from cvo_edge.engine.model_cache import ModelCache
from cvo_edge.engine.session import Session
from cvo_edge.errors import ModelError, UsageError
from cvo_edge.estimate import PoseInterval, Reason, Status
from cvo_edge.input.frame import Frame
from cvo_edge.input.frame_checks import StreamChecks
from cvo_edge.observer import Observation, Observer
from cvo_edge.pose import Pose
from cvo_edge.scheduling import checked_mode, plan, run_stream
from cvo_edge.sets import SCOPES, ConformalSet, Scope, unbounded_set

_STEEP_PITCH = np.deg2rad(80.0)


class Seen(NamedTuple):
    """One frame before its stream is known: what a worker returns and ``conclude`` takes.

    ``conformal_set`` is unbounded where the observation has a fault or a doubt. ``conformal_ms`` is
    what the set took, ``total_ms`` all from the image on.
    """

    frame: Frame
    seq: int
    observation: Observation
    conformal_set: ConformalSet
    conformal_ms: float
    total_ms: float


class Odometer:
    """Pose intervals from camera images, by one bundle.

    One instance serves one stream: it numbers the frames. Use it as a context manager, or call
    ``close``. Threads that call ``step`` on one instance wait for each other. A process that was
    forked from the one that loaded it has to load its own (UsageError), and to end by ``os._exit``,
    as the processes of ``multiprocessing`` do: onnxruntime does not let it end otherwise.

    Parameters
    ----------
    bundle
        A bundle as ``read_bundle`` returns it.
    threads
        Cores to use; all allowed ones by default.
    mode
        ``latency``, ``throughput`` or ``live``, see ``cvo_edge.scheduling``.
    confidence
        One of the confidences stored in the bundle.
    scope
        ``marginal``: the confidence holds for each degree of freedom; ``joint``: for all six at
        once.

    Raises
    ------
    UsageError
        A confidence that is not stored, or an unknown scope or mode.
    ModelError, BundleMismatchError
        The engine refuses the model.
    """

    def __init__(
        self,
        bundle: Bundle,
        *,
        threads: int | None = None,
        mode: str = "latency",
        confidence: float = 0.9,
        scope: Scope = "marginal",
    ) -> None:
        calibration = bundle.calibration
        self.calibration = calibration
        self.head = bundle.head
        self.threshold = _stored_threshold(calibration, confidence, scope)
        self.confidence = self.threshold.confidence
        self.scope = scope
        self.mode = checked_mode(mode)
        settings = plan(self.mode, threads)
        self._workers = settings.workers
        self.threads = settings.threads * settings.workers
        self._observer = Observer(
            bundle.model,
            calibration.model,
            calibration.preprocess,
            calibration.pose,
            bundle.head,
            threads=settings.threads,
            spinning=settings.spinning,
            at_once=settings.workers,
        )
        self.chart = self._observer.chart
        self._stream_checks = StreamChecks()
        self._stepping = Lock()
        self._seq = 0

    @classmethod
    def load(
        cls,
        bundle: str | os.PathLike[str],
        *,
        threads: int | None = None,
        mode: str = "latency",
        confidence: float = 0.9,
        scope: Scope = "marginal",
        cache: ModelCache | None = None,
        public_key: str | os.PathLike[str] | None = None,
    ) -> Odometer:
        """Read a bundle folder and be ready to step; parameters and errors as the class's.

        With a cache, e.g. ``ModelCache.default()``, the model is prepared for this machine once and
        later loaded in a fraction of time and memory; what it computes is the same. With a public
        key (PEM, Ed25519) only a bundle signed with it is taken, and no older version of it from
        then on.

        Raises also what ``read_bundle`` raises.
        """
        check = trust = None
        if public_key is not None:
            from cvo_edge.bundle.signature import Trust

            trust = Trust.in_key(Path(public_key))
            check = trust.check

        def opened(cache: ModelCache | None) -> Odometer:
            return cls(
                read_bundle(bundle, cache=cache, check=check),
                threads=threads,
                mode=mode,
                confidence=confidence,
                scope=scope,
            )

        try:
            odometer = opened(cache)
        except ModelError:
            if cache is None:
                raise
            # Another process may have cleared the cache in between.
            odometer = opened(None)
        if trust is not None:
            trust.remember()
        return odometer

    def __enter__(self) -> Odometer:
        """Return itself."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Close it."""
        self.close()

    def __repr__(self) -> str:
        return (
            f"<Odometer {self.calibration.name}: {self.calibration.method}, {self.confidence:g} "
            f"{self.scope}, mode {self.mode}, {self.threads} thread(s)>"
        )

    @property
    def session(self) -> Session | None:
        """The engine's session, for benchmarks beside it; None once closed."""
        return self._observer.session

    def close(self) -> None:
        """Give back the model's memory; closing twice is harmless, stepping afterwards an error."""
        self._observer.close()

    def step(
        self,
        image_bgr: NDArray[Any] | None,
        stamp_ns: int | None = None,
        source: str = "",
        read_ms: float = 0.0,
    ) -> PoseInterval:
        """Estimate the pose of one image and the set that holds it.

        Parameters
        ----------
        image_bgr
            Shape (height, width, 3), uint8, BGR as OpenCV reads it; grey, alpha and 16 bits are
            converted. None, or what is no image, gives an ``invalid`` estimate.
        stamp_ns
            Time of the image in integer nanoseconds, carried through.
        source
            Name of the image, carried through.
        read_ms
            What reading it took, for the record's latencies.

        Raises
        ------
        UsageError
            After ``close``, in a forked process, and for a stamp that is no int.
        ModelError
            The engine failed.
        """
        try:
            stamp_ns = None if stamp_ns is None else index(stamp_ns)
        except TypeError:
            raise UsageError(f"stamp_ns: expected an int or None, found {stamp_ns!r}") from None
        frame = Frame(image_bgr, stamp_ns, source, read_ms)
        # A frame is compared with the one before it: two threads must not interleave.
        with self._stepping:
            return self.conclude(self._see(frame, self._seq))

    def stream(self, frames: Iterable[Frame | NDArray[Any]]) -> Generator[PoseInterval, None, None]:
        """Step through a source, or through frames or bare BGR images, lazily, in their order.

        The mode decides how, see ``cvo_edge.scheduling``. In ``throughput`` the files of a source
        are also read and decoded in parallel. In ``live``, and with a camera in every mode, only
        the newest frame is used; the numbers of dropped frames are missing in ``seq``. In ``live``
        a recording is played by its stamps; an iterable of your own sets its own pace. The stream
        checks start anew. Your own images may be overwritten once the next one is asked for.

        Raises what the source raises, and UsageError for a path instead of a source, and in
        ``live`` for a recording without stamps.
        """
        if isinstance(frames, str | bytes | os.PathLike):
            raise UsageError(
                f"stream: expected a source or frames, found the path {os.fsdecode(frames)!r}; "
                "open it with open_source"
            )
        self._stream_checks = StreamChecks()
        with closing(
            run_stream(frames, self.mode, self._workers, self._see, lambda: self._seq)
        ) as stream:
            for seen in stream:
                yield self.conclude(seen)

    def observe(self, image_bgr: NDArray[Any] | None, seq: int) -> Observation:
        """Run the network on one image, without a threshold; see ``Observer.observe``."""
        return self._observer.observe(image_bgr, seq)

    def conformal_set(
        self, observation: Observation, threshold: Threshold | None = None
    ) -> ConformalSet:
        """Return the set of an observation, by default at the odometer's own threshold."""
        return self.head.conformal_set(
            observation.outputs, observation.point, threshold or self.threshold
        )

    def _see(self, frame: Frame, seq: int) -> Seen:
        """Everything that does not depend on the frames before; safe in several threads."""
        start = perf_counter()
        observation = self._observer.observe(frame.image, seq)
        observed = perf_counter()
        usable = observation.fault is None and observation.doubt is None
        found = self.conformal_set(observation) if usable else unbounded_set()
        end = perf_counter()
        return Seen(frame, seq, observation, found, 1e3 * (end - observed), 1e3 * (end - start))

    def conclude(self, seen: Seen) -> PoseInterval:
        """Add what the frames before speak against a frame; frames come once, in their order.

        A finite set is given only where neither the frame nor its stream raises a doubt.
        """
        frame, observation = seen.frame, seen.observation
        self._seq = seen.seq + 1
        fault, found = observation.fault, seen.conformal_set
        doubts = tuple(reason for reason in (observation.doubt, fault) if reason is not None)
        doubts += self._stream_checks.doubts(observation.look, frame.stamp_ns, frame.waited_ms)
        if doubts:
            found = unbounded_set()
        return PoseInterval(
            seq=seen.seq,
            stamp_ns=frame.stamp_ns,
            source=frame.source,
            status=Status.INVALID if fault else Status.DEGRADED if doubts else Status.OK,
            reasons=doubts or self._remarks(observation, found),
            pose=None if fault else Pose(observation.pose[:3], observation.pose[3:]),
            conformal_set=found,
            confidence=self.confidence,
            scope=self.scope,
            chart=self.chart,
            latency_ms={
                "read": round(frame.read_ms, 4),
                "preprocess": round(observation.preprocess_ms, 4),
                "model": round(observation.model_ms, 4),
                "conformal": round(seen.conformal_ms, 4),
                "total": round(frame.read_ms + frame.waited_ms + seen.total_ms, 4),
            },
        )

    @property
    def has_region(self) -> bool:
        """Whether a set is a region of all six degrees of freedom together, not six sets."""
        return self.scope == "joint" and self.head.one_joint_score

    def _remarks(self, observation: Observation, found: ConformalSet) -> tuple[Reason, ...]:
        remarks: tuple[Reason, ...] = ()
        if found.crossed:
            remarks += (Reason.BOUNDS_CROSSED,)
        if self.chart.rotation == "euler_zyx" and abs(observation.point[4]) > _STEEP_PITCH:
            remarks += (Reason.PITCH_NEAR_90,)
        return remarks


def _stored_threshold(calibration: Calibration, confidence: float, scope: Scope) -> Threshold:
    if scope not in SCOPES:
        raise UsageError(f"scope: expected one of {', '.join(SCOPES)}, found {scope!r}")
    threshold = calibration.threshold(float(confidence), scope)
    if threshold is not None:
        return threshold
    stored = calibration.confidences(scope)
    below = [value for value in stored if value < confidence]
    above = [value for value in stored if value > confidence]
    nearest = " and ".join(f"{value:g}" for value in (*below[-1:], *above[:1]))
    raise UsageError(
        f"confidence: expected one stored in the bundle for scope {scope} "
        f"({', '.join(f'{value:g}' for value in stored)}), found {confidence:g}; the nearest are "
        f"{nearest}"
    )
