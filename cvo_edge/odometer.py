"""The loop: camera image -> model input -> named outputs -> conformal set -> PoseInterval."""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from itertools import count
from operator import index
from pathlib import Path
from threading import Lock
from time import perf_counter
from types import TracebackType
from typing import Any, NamedTuple, TypedDict

import numpy as np
from numpy.typing import NDArray

from cvo_edge.bundle.format import MAX_NUMBER, Calibration, Threshold
from cvo_edge.bundle.reading import Bundle, read_bundle
from cvo_edge.engine.loading import PreparedBundle, load_bundle, open_session
from cvo_edge.engine.model_cache import ModelCache
from cvo_edge.engine.session import Session
from cvo_edge.errors import ModelError, UsageError
from cvo_edge.estimate import PoseInterval, Reason, Status
from cvo_edge.heads.checked import consistent_head
from cvo_edge.input import preprocess
from cvo_edge.input.clock import SYSTEM_CLOCK
from cvo_edge.input.frame import Frame, Source
from cvo_edge.input.frame_checks import Look, StreamChecks, image_doubt
from cvo_edge.input.newest import Newest, Played
from cvo_edge.pose import Chart, Pose
from cvo_edge.scheduling import Mode, checked_mode, in_order, plan
from cvo_edge.sets import ConformalSet, Scope, unbounded_set

Array = NDArray[np.float64]

_STEEP_PITCH = np.deg2rad(80.0)
# Numbers that Python looks at in less time than numpy's first call takes.
_FEW = 64


@dataclass(frozen=True, eq=False)
class Observation:
    """What the network says of one image, before any threshold.

    ``outputs`` by name, each with a leading axis of one; ``pose`` (7,) with a unit quaternion and
    ``point`` (6,), the same pose in the bundle's chart. Where ``fault`` is set none may be used;
    where ``doubt`` is set no interval may be claimed. ``look`` is None where no image was looked
    at.
    """

    outputs: dict[str, NDArray[np.float32]]
    pose: Array
    point: Array
    fault: Reason | None = None
    doubt: Reason | None = None
    look: Look | None = None
    preprocess_ms: float = 0.0
    model_ms: float = 0.0


class _Estimated(NamedTuple):
    """An estimate that the stream's checks have not seen yet, and what they look at."""

    estimate: PoseInterval
    look: Look | None
    frame: Frame


class _Settings(TypedDict):
    threads: int | None
    mode: Mode | str
    confidence: float
    scope: Scope


class Odometer:
    """Pose intervals from camera images, by one bundle.

    One instance serves one stream: it numbers the frames. Use it as a context manager, or call
    ``close``. Threads that ``step`` one instance wait for each other. A process that was forked
    from the one that loaded it has to load its own (UsageError), and to end by ``os._exit``, as
    those of ``multiprocessing`` do: onnxruntime does not let it end otherwise.

    Parameters
    ----------
    bundle
        A bundle as ``read_bundle`` or ``load_bundle`` returns it.
    threads
        Cores to use; all allowed ones by default.
    mode
        What a stream is to be good at: ``latency``, ``throughput`` or ``live``, see
        ``cvo_edge.scheduling``.
    confidence
        One of the confidences stored in the bundle.
    scope
        ``marginal``: the confidence holds for each degree of freedom; ``joint``: for all six at
        once.

    Raises
    ------
    UsageError
        A confidence that is not stored; the message lists those that are.
    CalibrationFileError, ModelError, BundleMismatchError
        The bundle is not what it has to be.
    """

    def __init__(
        self,
        bundle: Bundle | PreparedBundle,
        *,
        threads: int | None = None,
        mode: Mode | str = Mode.LATENCY,
        confidence: float = 0.9,
        scope: Scope = "marginal",
    ) -> None:
        calibration = bundle.calibration
        self.calibration = calibration
        self.confidence = confidence
        self.scope = scope
        self.threshold = self._stored_threshold(confidence, scope)
        self.head = consistent_head(calibration)
        model = bundle.model_bytes if isinstance(bundle, Bundle) else bundle.prepared
        self.mode = checked_mode(mode)
        settings = plan(self.mode, threads)
        self._workers = settings.workers
        self.threads = settings.threads * settings.workers
        self.session: Session | None = open_session(
            model,
            settings.threads,
            calibration.model,
            spinning=settings.spinning,
            at_once=settings.workers,
        )
        reference = calibration.pose.reference_q_xyzw
        self.chart = Chart(
            calibration.pose.rotation,
            np.array(reference) if calibration.pose.rotation == "tangent_reference" else None,
        )
        # A prediction is the origin of its own tangent: what is plausible needs a fixed one.
        self._limits_chart = self.chart
        if reference is not None and calibration.pose.rotation == "tangent_predicted":
            self._limits_chart = Chart("tangent_reference", np.array(reference))
        self._limits = calibration.pose.limits
        self._stream_checks = StreamChecks()
        self._clock = SYSTEM_CLOCK
        self._stepping = Lock()
        self._seq = 0

    @classmethod
    def load(
        cls,
        bundle: str | Path,
        *,
        threads: int | None = None,
        mode: Mode | str = Mode.LATENCY,
        confidence: float = 0.9,
        scope: Scope = "marginal",
        cache: ModelCache | None = None,
        public_key: str | Path | None = None,
    ) -> Odometer:
        """Read the bundle folder and be ready to step; parameters and errors as the class's.

        With a cache, e.g. ``ModelCache.default()``, the model is prepared for this machine once and
        later loaded in a fraction of time and memory; what it computes is the same. With a public
        key (PEM, Ed25519) only a bundle signed with it is taken, and no older version of it from
        then on.
        """
        folder = Path(bundle)
        trust = None
        if public_key is not None:
            from cvo_edge.bundle.signature import Trust

            trust = Trust.in_key(Path(public_key))

        def check(folder: Path, calibration: Calibration, content: bytes) -> None:
            """All that can be known before the model is loaded, or prepared."""
            consistent_head(calibration)
            if trust is not None:
                trust.check(folder, calibration, content)

        if cache is None:
            content: Bundle | PreparedBundle = read_bundle(folder, check)
        else:
            content = load_bundle(folder, cache, check)
        settings: _Settings = {
            "threads": threads,
            "mode": mode,
            "confidence": confidence,
            "scope": scope,
        }
        try:
            odometer = cls(content, **settings)
        except ModelError:
            if isinstance(content, Bundle):
                raise
            # Someone has cleared the cache in between.
            odometer = cls(read_bundle(folder, check), **settings)
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

    def close(self) -> None:
        """Give back the model's memory; closing twice is harmless, stepping afterwards an error."""
        self.session = None

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
            onnxruntime failed.
        """
        try:
            stamp_ns = None if stamp_ns is None else index(stamp_ns)
        except TypeError:
            raise UsageError(f"stamp_ns: expected an int or None, found {stamp_ns!r}") from None
        frame = Frame(image_bgr, stamp_ns, source, read_ms)
        # A frame is compared with the one before, so that they have to come one after the other.
        with self._stepping:
            return self._in_stream(self._estimate(frame, self._next_seq()))

    def stream(self, frames: Iterable[Frame | NDArray[Any]]) -> Generator[PoseInterval, None, None]:
        """Step through a source, or through frames or bare BGR images, lazily, in its order.

        The mode says how. In ``throughput`` the files of a source are also read and decoded beside
        each other. In ``live``, and of a camera in every mode, only the newest frame is used; the
        numbers of those that were left out are missing in ``seq``. A recording is played by its
        stamps in ``live``, frames of your own come when they come. The stream's checks begin anew.
        Images of your own may be written over once the next one is asked for.
        Raises what the source raises, and in ``live`` UsageError for a recording without stamps.
        """
        self._stream_checks = StreamChecks()
        # What a camera gives has to be taken as it comes: what is left lying is old.
        if self.mode is Mode.LIVE or (isinstance(frames, Source) and frames.live):
            yield from self._newest(frames)
        elif self.mode is Mode.THROUGHPUT:
            yield from self._beside_each_other(
                frames.reads() if isinstance(frames, Source) else map(_already_read, frames)
            )
        else:
            yield from self._one_by_one(map(_as_frame, frames))

    def _newest(self, frames: Iterable[Frame | NDArray[Any]]) -> Iterator[PoseInterval]:
        if isinstance(frames, Source):
            coming = frames if frames.live else Played(frames, self._clock)
            # Sources of others need not have it.
            newest = Newest(coming, getattr(coming, "stop", None), self._clock)
        else:
            newest = Newest(map(_kept, frames), clock=self._clock)
        with closing(iter(newest)) as frames_in_time:
            yield from self._one_by_one(frames_in_time)

    def _one_by_one(self, frames: Iterable[Frame]) -> Iterator[PoseInterval]:
        for frame in frames:
            self._seq += frame.skipped
            yield self._in_stream(self._estimate(frame, self._next_seq()))

    def _beside_each_other(self, reads: Iterable[Callable[[], Frame]]) -> Iterator[PoseInterval]:
        numbered = zip(count(self._seq), reads, strict=False)
        tasks = (partial(self._read_and_estimate, seq, read) for seq, read in numbered)
        with closing(in_order(tasks, self._workers)) as estimates:
            for estimated in estimates:
                # Those under way when a stream is left have not been given to anyone.
                self._seq = estimated.estimate.seq + 1
                yield self._in_stream(estimated)

    def _read_and_estimate(self, seq: int, read: Callable[[], Frame]) -> _Estimated:
        return self._estimate(read(), seq)

    def _next_seq(self) -> int:
        seq = self._seq
        self._seq += 1
        return seq

    def _estimate(self, frame: Frame, seq: int) -> _Estimated:
        waited_ms = frame.since_arrival_ms(self._clock.now_s())
        start = perf_counter()
        observation = self.observe(frame.image, seq)
        concluded = perf_counter()
        fault, doubt = observation.fault, observation.doubt
        against = tuple(reason for reason in (doubt, fault) if reason is not None)
        found = unbounded_set() if against else self.conformal_set(observation)
        reasons = against or self._remarks(observation, found)
        end = perf_counter()
        estimate = PoseInterval(
            seq=seq,
            stamp_ns=frame.stamp_ns,
            source=frame.source,
            status=Status.INVALID if fault else Status.DEGRADED if doubt else Status.OK,
            reasons=reasons,
            pose=None if fault else Pose(observation.pose[:3], observation.pose[3:]),
            conformal_set=found,
            confidence=self.confidence,
            scope=self.scope,
            chart=self.chart,
            latency_ms={
                "read": round(frame.read_ms, 4),
                "preprocess": round(observation.preprocess_ms, 4),
                "model": round(observation.model_ms, 4),
                "conformal": round(1e3 * (end - concluded), 4),
                "total": round(max(frame.read_ms, waited_ms) + 1e3 * (end - start), 4),
            },
        )
        return _Estimated(estimate, observation.look, frame)

    def _in_stream(self, estimated: _Estimated) -> PoseInterval:
        """Take back what the frames before an estimate's speak against; they come in order."""
        estimate, look, frame = estimated
        # The age counts until the estimate is given: a process may be stopped at any point.
        age_ms = frame.age_ms(self._clock.now_s())
        doubts = self._stream_checks.doubts(look, estimate.stamp_ns, age_ms)
        if not doubts:
            return estimate
        if estimate.status is Status.OK:
            # Remarks on bounds that are not given any more would say nothing.
            return replace(
                estimate, status=Status.DEGRADED, reasons=doubts, conformal_set=unbounded_set()
            )
        return replace(estimate, reasons=(*estimate.reasons, *doubts))

    def observe(self, image_bgr: NDArray[Any] | None, seq: int) -> Observation:
        """Run the network on one image; what the frame checks say is in ``fault`` and ``doubt``."""
        session = self.session
        if session is None:
            raise UsageError("Odometer: expected an open one, found it closed")
        if image_bgr is None:
            return _faulty(Reason.IMAGE_UNREADABLE)
        start = perf_counter()
        image = preprocess.to_bgr8(image_bgr)
        if image is None:
            return _faulty(Reason.IMAGE_UNSUPPORTED)
        spec = self.calibration.preprocess
        tensor = preprocess.model_input(image, spec.height, spec.width, spec.crop)
        look = Look(tensor, (image.shape[0], image.shape[1]))
        doubt = image_doubt(look)
        ready = perf_counter()
        outputs = session.run({"image": tensor, **self.head.extra_inputs(seq)})
        done = perf_counter()
        pose, point, fault = self._checked(outputs)
        spent_ms = 1e3 * (ready - start), 1e3 * (done - ready)
        return Observation(outputs, pose, point, fault, doubt, look, *spent_ms)

    def _checked(
        self, outputs: dict[str, NDArray[np.float32]]
    ) -> tuple[Array, Array, Reason | None]:
        """Outputs -> unit pose (7,) and point (6,), and what is wrong with them.

        A network has just driven all else out of the processor's caches: few numbers are better
        looked at one by one than by many of numpy's functions.
        """
        values = outputs["pose"][0].tolist()
        sensible = all(map(_sensible, outputs.values()))
        if not sensible and not all(np.isfinite(output).all() for output in outputs.values()):
            return np.array(values), np.array(values[:6]), Reason.OUTPUT_NOT_FINITE
        length = math.hypot(*values[3:])
        # Unit, and of the two quaternions of a rotation the one with qw >= 0.
        scale = math.copysign(length, values[6]) if length > 0.0 else math.nan
        pose = np.array([*values[:3], *(value / scale for value in values[3:])])
        point = plausible = self.chart.point(pose)
        if self._limits_chart is not self.chart:
            plausible = self._limits_chart.point(pose)
        # Written so that NaN (a zero quaternion) fails the check.
        inside = all(
            lowest <= value <= highest
            for lowest, value, highest in zip(
                self._limits.lowest, plausible.tolist(), self._limits.highest, strict=True
            )
        )
        if not inside:
            return pose, point, Reason.POSE_IMPLAUSIBLE
        return pose, point, None if sensible else Reason.OUTPUT_ABSURD

    @property
    def has_region(self) -> bool:
        """Whether sets are a region of all six degrees of freedom, not six sets."""
        return self.scope == "joint" and self.head.one_joint_score

    def conformal_set(
        self, observation: Observation, threshold: Threshold | None = None
    ) -> ConformalSet:
        """The conformal set of an observation, by default at the odometer's own threshold."""
        return self.head.conformal_set(
            observation.outputs, observation.point, threshold or self.threshold
        )

    def _stored_threshold(self, confidence: float, scope: Scope) -> Threshold:
        threshold = self.calibration.threshold(confidence, scope)
        if threshold is None:
            stored = ", ".join(f"{value:g}" for value in self.calibration.confidences(scope))
            raise UsageError(
                f"confidence: expected one stored in the bundle for scope {scope} "
                f"({stored or 'none'}), found {confidence:g}"
            )
        return threshold

    def _remarks(self, observation: Observation, found: ConformalSet) -> tuple[Reason, ...]:
        remarks: tuple[Reason, ...] = ()
        if found.crossed:
            remarks += (Reason.BOUNDS_CROSSED,)
        if self.chart.rotation == "euler_zyx" and abs(observation.point[4]) > _STEEP_PITCH:
            remarks += (Reason.PITCH_NEAR_90,)
        return remarks


def _sensible(output: NDArray[np.float32]) -> bool:
    """Whether all numbers are there and none is absurd."""
    if output.size > _FEW:
        return bool(np.abs(output).max() < MAX_NUMBER)
    values = output.ravel().tolist()
    # NaN is in a sum wherever it is, but in a maximum only where it comes first.
    return max(map(abs, values)) < MAX_NUMBER and not math.isnan(sum(values))


def _as_frame(frame: Frame | NDArray[Any]) -> Frame:
    return frame if isinstance(frame, Frame) else Frame(frame, None, "", 0.0)


def _kept(frame: Frame | NDArray[Any]) -> Frame:
    """A frame of a caller's, who may write the next image into the same memory."""
    given = _as_frame(frame)
    image = given.image
    return replace(given, image=image.copy() if isinstance(image, np.ndarray) else image)


def _already_read(frame: Frame | NDArray[Any]) -> Callable[[], Frame]:
    kept = _kept(frame)
    return lambda: kept


def _faulty(reason: Reason) -> Observation:
    return Observation({}, np.full(7, np.nan), np.full(6, np.nan), reason)
