"""The loop: camera image -> observation -> conformal set -> PoseInterval."""

from __future__ import annotations

import os
from collections.abc import Callable, Generator, Iterable
from contextlib import closing
from functools import partial
from threading import Lock
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cvo_edge.bundle.format import Threshold
from cvo_edge.bundle.quantiles import threshold_at
from cvo_edge.camera import Camera, checked_camera
from cvo_edge.camera_check import LensEstimate
from cvo_edge.engine.loading import Bundle, read_bundle
from cvo_edge.engine.model_cache import ModelCache
from cvo_edge.engine.observation import Observation, Observer
from cvo_edge.engine.selftest import check_selftest
from cvo_edge.engine.session import Session
from cvo_edge.errors import GateError, ModelError, UsageError
from cvo_edge.estimate import Drift, PoseInterval
from cvo_edge.given import given_path
from cvo_edge.input.clock import SYSTEM_CLOCK
from cvo_edge.input.frame import Frame, checked_hint
from cvo_edge.input.half import halve
from cvo_edge.monitor.adaptation import Adaptation
from cvo_edge.monitor.labelled import Labelled
from cvo_edge.monitor.watch import StreamWatch
from cvo_edge.pose import Pose
from cvo_edge.processed import Processed
from cvo_edge.record import Status
from cvo_edge.scheduling import checked_mode, plan, run_stream
from cvo_edge.sets import ConformalSet, unbounded_set
from cvo_edge.vocabulary import Scope


class Odometer(Labelled):
    """Estimates pose intervals from camera images with one bundle.

    One instance serves one stream and numbers its frames. Use it as a context manager, or call
    ``close``. Concurrent calls of ``step`` on one instance run one after another. A forked process
    cannot use its parent's instance (UsageError) and must load its own; it must end by
    ``os._exit``, as ``multiprocessing`` does, because onnxruntime blocks a normal exit.

    Parameters
    ----------
    bundle
        A bundle as ``read_bundle`` returns it.
    threads
        Number of cores to use; all allowed cores by default.
    mode
        ``latency``, ``throughput`` or ``live``, see ``cvo_edge.scheduling``.
    confidence
        One that the bundle stores, or any if it holds quantiles of its calibration scores.
    scope
        ``marginal``: the confidence holds for each degree of freedom; ``joint``: for all six at
        once.
    camera
        The camera that takes the images, if it is not the bundle's own. For methods that do not
        solve for the pose, its images must show all that those of the bundle's camera show.
    adapt
        Adapt the thresholds to the labels that ``update`` gets.
    state
        File that keeps what was adapted; implies ``adapt``. Errors: ``StateFile``.

    Raises
    ------
    UsageError
        A confidence, scope or mode that there is not, or a camera that does not fit the bundle's.
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
        camera: Camera | None = None,
        adapt: bool = False,
        state: str | os.PathLike[str] | None = None,
    ) -> None:
        calibration = bundle.calibration
        self.calibration = calibration
        self.head = bundle.head
        self.threshold = threshold_at(calibration, confidence, scope)
        self.confidence = self.threshold.confidence
        self.scope = scope
        self.mode = checked_mode(mode)
        settings = plan(self.mode, threads)
        self._workers = settings.workers
        self.threads = settings.threads * settings.workers
        camera = None if camera is None else checked_camera(camera)
        self._observer = Observer(
            bundle.model,
            calibration.model,
            calibration.preprocess,
            calibration.pose,
            bundle.head,
            calibration.camera,
            camera,
            calibration.images,
            threads=settings.threads,
            spinning=settings.spinning,
            at_once=settings.workers,
        )
        self.chart = self._observer.chart
        self.origin_m = self._observer.origin_m
        self._watch = StreamWatch(self._observer, calibration)
        if adapt or state is not None:
            self._adaptation = Adaptation(self.head, self.chart, calibration, self.threshold, state)
        self._clock = SYSTEM_CLOCK
        self._stepping = Lock()
        self._seq = 0
        self._loaded: Callable[[], Odometer] | None = None

    @classmethod
    def load(
        cls,
        bundle: str | os.PathLike[str],
        *,
        threads: int | None = None,
        mode: str = "latency",
        confidence: float = 0.9,
        scope: Scope = "marginal",
        camera: Camera | None = None,
        adapt: bool = False,
        state: str | os.PathLike[str] | None = None,
        cache: ModelCache | None = None,
        public_key: str | os.PathLike[str] | None = None,
        name: str | None = None,
    ) -> Odometer:
        """Load a bundle folder; parameters and errors are those of the class.

        With a cache, e.g. ``ModelCache.default()``, the model is optimised for this machine once;
        later loads need a fraction of the time and memory, and results are bit-identical. With a
        public key (PEM, Ed25519), the bundle must be signed with that key. Once it has passed its
        self-test (else GateError), older versions are rejected, and bundles of another name in the
        same folder, unless ``name`` names them. Raises the errors of ``read_bundle``, too.
        """
        check = trust = None
        sealed = cache
        if public_key is not None:
            from cvo_edge.bundle.signature import Trust

            trust = Trust.in_key(given_path(public_key, "public_key"), name)
            check = trust.check
            sealed = None if cache is None else cache.sealed(trust.record, trust.key_sha256)
        elif name is not None:
            raise UsageError(f"name: expected a public key with it, found none with {name}")

        settings: dict[str, Any] = {"threads": threads, "mode": mode, "confidence": confidence}
        settings |= {"scope": scope, "camera": camera, "adapt": adapt, "state": state}
        try:
            odometer = cls(read_bundle(bundle, cache=sealed, check=check), **settings)
        except ModelError:
            if sealed is None:
                raise
            # Another process may have cleared the cache after it was read.
            odometer = cls(read_bundle(bundle, cache=None, check=check), **settings)
        settings |= {"cache": cache, "public_key": public_key, "name": name}
        odometer._loaded = partial(cls.load, bundle, **settings)
        if trust is not None and trust.is_new:
            try:
                check_selftest(odometer)
            except GateError:
                odometer.close()
                raise
            trust.remember()
        return odometer

    def __reduce__(self) -> tuple[Callable[[], Odometer], tuple[()]]:
        """Copy or pickle by folder and settings: the copy loads the bundle and starts a stream."""
        if self._loaded is None:
            raise UsageError("copy: expected an odometer of Odometer.load, found one of a Bundle")
        return self._loaded, ()

    def __repr__(self) -> str:
        calibration = self.calibration
        state = "" if self.session is not None else ", closed"
        return (
            f"<Odometer {calibration.name!r}: {calibration.method}, {self.confidence:g} "
            f"{self.scope}, {self.mode} mode{state}>"
        )

    def __enter__(self) -> Odometer:
        """Return itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close it."""
        self.close()

    @property
    def session(self) -> Session | None:
        """The engine's session, for comparison in benchmarks; None after ``close``."""
        return self._observer.session

    def close(self) -> None:
        """Release model and state file; repeated calls are harmless, later steps raise."""
        self._observer.close()
        if self._adaptation is not None:
            self._adaptation.close()

    def step(
        self,
        image_bgr: NDArray[Any] | None,
        stamp_ns: int | None = None,
        source: str = "",
        read_ms: float = 0.0,
        *,
        moving: bool | None = None,
        fresh_noise: bool = True,
    ) -> PoseInterval:
        """Estimate the camera pose of one image and the set that holds it.

        Parameters
        ----------
        image_bgr
            Shape (height, width, 3), uint8, BGR, in the sensor's pixel order, as read by
            ``cv2.imread`` with ``cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION``; grey images,
            alpha channels and 16 bits are converted. None, or anything but an image, gives an
            ``invalid`` estimate. A bundle of ``decode: half`` needs JPEG files that were read with
            ``cv2.IMREAD_REDUCED_COLOR_2`` instead of ``cv2.IMREAD_COLOR``.
        stamp_ns
            Time of the image in integer nanoseconds; copied to the result.
        source
            Name of the image; copied to the result.
        read_ms
            Time it took to read the image, for the record's latencies.
        moving
            Whether the camera moves, by other sensors or its commands, if that is known: a picture
            that stands still while the camera moves is a doubt.
        fresh_noise
            False for images decoded from a video codec that predicts pictures from others (H.264),
            and for simulated ones without noise: equal parts of two images then prove nothing.

        Raises
        ------
        UsageError
            The odometer is closed or was loaded before a fork, the stamp is not an int, or
            ``moving`` is not a bool.
        ModelError
            Inference failed.
        """
        moving = checked_hint(moving)
        frame = Frame(image_bgr, stamp_ns, source, read_ms, fresh_noise=fresh_noise, moving=moving)
        # Stream checks compare consecutive frames, so threads must not interleave.
        with self._stepping:
            return self.conclude(self._process(frame, self._seq))

    def stream(
        self, frames: Iterable[Frame | NDArray[Any]], *, moving: bool | None = None
    ) -> Generator[PoseInterval, None, None]:
        """Yield estimates for a source, for frames or for BGR images, lazily and in order.

        The mode decides how frames are processed (see ``cvo_edge.scheduling``). In ``throughput``
        mode the files of a source are also read and decoded in parallel. In ``live`` mode, and with
        a camera in every mode, only the newest frame is used; ``seq`` skips the numbers of dropped
        frames. ``live`` mode plays a recording by its stamps; any other iterable sets its own pace.
        The stream checks start again. You may overwrite an image after requesting the next one.
        ``moving`` is as for ``step``, for the frames that do not say it themselves.

        Raises the source's errors; raises UsageError for a path instead of a source, in ``live``
        mode for a recording without stamps, and for a source that cannot give what a bundle of
        ``decode: half`` needs, JPEG images.
        """
        moving = checked_hint(moving)
        if self.calibration.preprocess.decode == "half":
            halve(frames)
        self._watch = StreamWatch(self._observer, self.calibration)
        work = partial(self._process, moving=moving, beside_others=self.mode == "throughput")
        with closing(
            run_stream(frames, self.mode, self._workers, work, lambda: self._seq, self._clock)
        ) as stream:
            for processed in stream:
                yield self.conclude(processed)

    def _process(
        self,
        frame: Frame,
        seq: int,
        *,
        moving: bool | None = None,
        beside_others: bool = False,
    ) -> Processed:
        """Process a frame; ``beside_others``: in a worker thread, without the stream checks."""
        frame = frame.told(moving)
        waited_ms = max(frame.read_ms, frame.since_arrival_ms(self._clock.now_s()))
        start = perf_counter()
        prepared = self._observer.prepare(frame.image)
        picture = None if beside_others else self._watch.picture(prepared.look, frame)
        observation = self._observer.infer(prepared, seq)
        observed = perf_counter()
        usable = observation.fault is None and observation.doubt is None
        level = None if self._adaptation is None else self._adaptation.level
        threshold = self.threshold if level is None else level.threshold
        found = self.conformal_set(observation, threshold) if usable else unbounded_set()
        end = perf_counter()
        conformal_ms, total_ms = 1e3 * (end - observed), waited_ms + 1e3 * (end - start)
        return Processed(frame, seq, observation, found, conformal_ms, total_ms, level, picture)

    def conclude(self, processed: Processed) -> PoseInterval:
        """Apply the stream checks and build the estimate; call it once per frame, in order.

        The set is finite only if neither the frame checks nor the stream checks raise a doubt.
        """
        frame, observation = processed.frame, processed.observation
        self._seq = processed.seq + 1
        fault, found = observation.fault, processed.conformal_set
        # The age counts until the estimate is given: a process may be stopped at any point.
        age_ms = frame.age_ms(self._clock.now_s())
        picture = processed.picture
        if picture is None:
            picture = self._watch.picture(observation.look, frame)
        verdict = self._watch.judge(observation, picture, processed.seq, frame, age_ms)
        doubts = verdict.doubts
        centre = self.chart.turn_centre(observation.point)
        found = unbounded_set() if doubts else found.trimmed(centre)
        position_m = observation.pose[:3]
        if self.origin_m is not None:
            origin_m = np.array(self.origin_m)
            position_m, found = position_m + origin_m, found.moved(origin_m)
        level = processed.level
        if self._adaptation is not None and level is not None:
            self._adaptation.remember(processed.seq, level, None if doubts else observation)
        return PoseInterval(
            seq=processed.seq,
            stamp_ns=frame.stamp_ns,
            source=frame.source,
            status=Status.INVALID if fault else Status.DEGRADED if doubts else Status.OK,
            reasons=doubts or self._watch.remarks(observation, found),
            pose=None if fault else Pose(position_m, observation.pose[3:]),
            conformal_set=found,
            confidence=self.confidence,
            scope=self.scope,
            chart=self.chart,
            latency_ms=processed.latency_ms(),
            factor=None if level is None else level.factor,
            drift=verdict.drift,
            novelty=verdict.novelty,
        )

    @property
    def drift(self) -> Drift:
        """Whether the stream's images are still like those of the calibration."""
        return self._watch.drift

    @property
    def seen_camera(self) -> LensEstimate | None:
        """The camera that the frames of the stream show, relative to the stated one.

        None if the method cannot tell, for fewer than 20 frames, or if no camera explains them.
        """
        return self._watch.seen_camera

    @property
    def unproven_frames(self) -> int:
        """Frames of the stream without fresh noise, whose equal parts prove no repetition."""
        return self._watch.unproven

    @property
    def image(self) -> NDArray[Any] | None:
        """The image of the last estimate as its source gave it, e.g. for ``PoseInterval.draw``."""
        return self._watch.image

    def observe(self, image_bgr: NDArray[Any] | None, seq: int) -> Observation:
        """Run the network on one image without applying a threshold; see ``Observer.observe``.

        Positions of the observation and of its ``conformal_set`` are relative to ``origin_m``.
        """
        return self._observer.observe(image_bgr, seq)

    def solver_error(self) -> float:
        """Return how wrong the method's solver is on this machine; see ``Head.solver_error``."""
        return self._observer.solver_error()

    def conformal_set(
        self, observation: Observation, threshold: Threshold | None = None
    ) -> ConformalSet:
        """Return the set of an observation, by default with the calibrated threshold."""
        return self.head.conformal_set(
            observation.outputs, observation.point, threshold or self.threshold
        )

    @property
    def has_region(self) -> bool:
        """Whether sets are joint regions of all six degrees of freedom."""
        return self.scope == "joint" and self.head.one_joint_score
