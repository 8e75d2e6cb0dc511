"""The command ``serve``: a camera's estimates, as long as the machine runs."""

from __future__ import annotations

import faulthandler
import math
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import TYPE_CHECKING, Annotated

import typer

from cvo_edge.errors import UsageError
from cvo_edge.files import check_output
from cvo_edge.process import Terminated, clean_up_within, say
from cvo_edge.programs.options import (
    REPORT,
    BaseOption,
    BundleArgument,
    CacheOption,
    CameraOption,
    ChildFrameIdOption,
    ExpectMotionOption,
    FollowOption,
    FormatOption,
    FrameIdOption,
    MapOption,
    MavlinkOption,
    MetricsOption,
    ModeOption,
    NameOption,
    OutputOption,
    PublicKeyOption,
    RegionOption,
    RunConfidenceOption,
    RunScopeOption,
    SourceArgument,
    StateOption,
    ThreadsOption,
    TimeoutOption,
    UnknownVarianceOption,
)

if TYPE_CHECKING:
    from cvo_edge.input.frame import Source
    from cvo_edge.programs.notify import Notifier
    from cvo_edge.programs.service import Service
    from cvo_edge.vocabulary import Format

# To finish the frames that were given, and to account for them, also on a busy machine.
_PATIENCE_S = 4.0


def serve(
    bundle: BundleArgument,
    source: SourceArgument,
    output: OutputOption = "-",
    format: FormatOption = None,
    region: RegionOption = False,
    health_every: Annotated[
        float,
        typer.Option(
            min=0.1, metavar="<seconds>", help="Time between health lines.", rich_help_panel=REPORT
        ),
    ] = 60.0,
    confidence: RunConfidenceOption = 0.9,
    scope: RunScopeOption = "marginal",
    state: StateOption = None,
    camera: CameraOption = None,
    expect_motion: ExpectMotionOption = False,
    follow: FollowOption = False,
    timeout: TimeoutOption = None,
    mode: ModeOption = None,
    threads: ThreadsOption = None,
    cache: CacheOption = True,
    public_key: PublicKeyOption = None,
    name: NameOption = None,
    mavlink: MavlinkOption = None,
    metrics: MetricsOption = None,
    base: BaseOption = None,
    map: MapOption = None,
    frame_id: FrameIdOption = None,
    child_frame_id: ChildFrameIdOption = None,
    unknown_variance: UnknownVarianceOption = None,
) -> None:
    """Estimate a camera's frames as a service: outlives a lost camera and a full disk."""
    from cvo_edge.engine.selftest import check_selftest
    from cvo_edge.input.waiting import Waiting
    from cvo_edge.output.sinks import format_of
    from cvo_edge.programs.job import Wanted, opened
    from cvo_edge.programs.notify import Notifier
    from cvo_edge.programs.placing import Placing
    from cvo_edge.programs.run import run as run_frames
    from cvo_edge.programs.service import Service

    # The range of the option's type lets NaN through, which is never due.
    if not math.isfinite(health_every):
        raise UsageError(f"--health-every: expected a number of seconds, found {health_every}")
    written_as: Format = format_of(output, format)
    if output != "-" and written_as not in ("jsonl", "tum"):
        raise UsageError(
            f"serve: expected the format jsonl or tum, which a restart adds to, found {written_as}"
        )
    wanted = Wanted(
        bundle=bundle,
        source=source,
        output=output,
        format=written_as,
        existing="append",
        region=region,
        confidence=confidence,
        scope=scope,
        camera=camera,
        timeout=timeout,
        follow=follow,
        mode=mode,
        threads=threads,
        cache=cache,
        public_key=public_key,
        name=name,
        state=state,
        mavlink=mavlink,
        metrics=metrics,
        placing=Placing(base, map, frame_id, child_frame_id, unknown_variance),
    )
    check_output(output, source, bundle, public_key, camera, state, force=None)
    notifier = Notifier()

    def told(line: str) -> None:
        say(line)
        notifier.status(line)

    waiting = Waiting(told)
    service = Service(waiting, notifier, told, health_every)

    if sys.stderr is not None:
        # A watchdog's SIGABRT then says where each thread was.
        faulthandler.enable(sys.stderr)
    with opened(wanted, patience=waiting, around=service.around, counts=service.counts) as job:
        check_selftest(job.odometer)
        try:
            with _signals(job.frames, service, notifier):
                service.start(job)
                run_frames(
                    job.odometer,
                    job.frames,
                    service.write,
                    summary=job.summary,
                    expect_motion=expect_motion,
                )
        finally:
            notifier.stopping()
            service.end()
            say("\n".join([*job.summary.lines(), *service.lines()]))


@contextmanager
def _signals(frames: Source, service: Service, notifier: Notifier) -> Iterator[None]:
    """Handle signals as a service does, within this block.

    SIGTERM and SIGINT end a camera, so that the frames that it has given are finished. SIGHUP opens
    files again, by the handler that is there, and systemd is told. SIGUSR1 asks for the health
    line.
    """
    clean_up_within(_PATIENCE_S)
    reopening = signal.getsignal(signal.SIGHUP)

    def end(*_: object) -> None:
        notifier.stopping()
        stop = getattr(frames, "stop", None)
        if stop is None:
            raise Terminated(0)
        stop()

    def hang_up(number: int, frame: FrameType | None) -> None:
        notifier.reloading()
        if callable(reopening):
            reopening(number, frame)
        notifier.ready("output files are opened again")

    handlers: dict[signal.Signals, Callable[[int, FrameType | None], object]] = {
        signal.SIGTERM: end,
        signal.SIGINT: end,
        signal.SIGUSR1: lambda *_: service.say_health(),
    }
    if callable(reopening):
        handlers[signal.SIGHUP] = hang_up
    before = {kind: signal.signal(kind, handler) for kind, handler in handlers.items()}
    try:
        yield
    except Terminated as ended:
        if ended.code:
            raise
    finally:
        for kind, former in before.items():
            signal.signal(kind, former)
