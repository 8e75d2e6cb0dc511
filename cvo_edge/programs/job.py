"""What ``run`` and ``serve`` open alike: the source, the odometer, and the sinks of estimates."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from cvo_edge.camera import read_camera
from cvo_edge.errors import UsageError
from cvo_edge.estimate import PoseInterval
from cvo_edge.ground_truth import GroundTruth
from cvo_edge.input.frame import Source
from cvo_edge.input.half import halve
from cvo_edge.input.sources import open_source
from cvo_edge.input.waiting import Patience
from cvo_edge.odometer import Odometer
from cvo_edge.output.mavlink import MavlinkSink
from cvo_edge.output.messages import Placement
from cvo_edge.output.metrics import Counts, MetricsSink
from cvo_edge.output.opening import PLACED, Writing, open_sink
from cvo_edge.output.records import header_of
from cvo_edge.output.rerun import RerunSink
from cvo_edge.process import say
from cvo_edge.programs.options import model_cache
from cvo_edge.programs.placing import Placing
from cvo_edge.programs.run import RunSummary
from cvo_edge.scheduling import usual_mode
from cvo_edge.vocabulary import Existing, Format, Mode, Scope

# What is written, and what opens it.
Opening = Callable[[], AbstractContextManager[Writing]]
Around = Callable[[str, Opening], AbstractContextManager[Writing]]


@dataclass(frozen=True, kw_only=True)
class Wanted:
    """The options that both commands have; each means what its help says."""

    bundle: Path
    source: str
    output: str
    format: Format
    existing: Existing
    region: bool
    confidence: float
    scope: Scope
    camera: Path | None
    timeout: float | None
    mode: Mode | None
    threads: int | None
    cache: bool
    public_key: Path | None
    name: str | None
    state: Path | None
    mavlink: str | None
    metrics: int | None
    placing: Placing
    fps: float | None = None
    stamps: str | None = None
    follow: bool = False
    adapt: bool = False
    view: bool = False
    bit_depth: int = 16


@dataclass(frozen=True)
class Job:
    """An odometer, its source, and where its estimates go."""

    odometer: Odometer
    frames: Source
    summary: RunSummary
    sinks: list[Writing]

    def write(self, estimate: PoseInterval) -> None:
        """Write an estimate to every sink."""
        for sink in self.sinks:
            sink.write(estimate)


def _plainly(_: str, opening: Opening) -> AbstractContextManager[Writing]:
    return opening()


@contextmanager
def opened(
    wanted: Wanted,
    *,
    truth: GroundTruth | None = None,
    patience: Patience | None = None,
    around: Around = _plainly,
    counts: Counts | None = None,
) -> Iterator[Job]:
    """Open what is wanted, and close it at the end.

    ``patience`` is for a camera, ``around`` opens a sink by its name and its opening, ``counts``
    are added to the metrics.
    """
    if wanted.follow and wanted.mode == "throughput":
        raise UsageError("--follow: expected the mode latency or live, found throughput")
    frames = open_source(
        wanted.source,
        wanted.fps,
        wanted.timeout,
        wanted.stamps,
        patience,
        wanted.threads,
        live=wanted.mode == "live",
        follow=wanted.follow,
        bit_depth=wanted.bit_depth,
    )
    with (
        Odometer.load(
            wanted.bundle,
            threads=wanted.threads,
            mode=wanted.mode or usual_mode(frames, adapts=wanted.adapt),
            confidence=wanted.confidence,
            scope=wanted.scope,
            camera=read_camera(wanted.camera) if wanted.camera else None,
            adapt=wanted.adapt,
            state=wanted.state,
            cache=model_cache(wanted.cache),
            public_key=wanted.public_key,
            name=wanted.name,
        ) as odometer,
        ExitStack() as stack,
    ):
        if odometer.calibration.preprocess.decode == "half":
            halve(frames)
        if wanted.region and not odometer.has_region:
            raise UsageError(
                f"--region: expected a bundle of mcqr, scr or fused and the joint scope, found "
                f"{odometer.calibration.method} and {wanted.scope}"
            )
        openings = _openings(wanted, odometer, frames, counts)
        sinks = [stack.enter_context(around(name, opening)) for name, opening in openings]
        summary = RunSummary(odometer.chart.dof, wanted.confidence, wanted.scope, truth=truth)
        yield Job(odometer, frames, summary, sinks)


def _openings(
    wanted: Wanted, odometer: Odometer, frames: Source, counts: Counts | None
) -> Iterator[tuple[str, Opening]]:
    """Yield what estimates are sent to."""
    header = header_of(
        odometer.calibration,
        odometer.chart,
        odometer.confidence,
        wanted.scope,
        stamps="fps" if wanted.fps else "arrival" if frames.live else None,
    )
    placed = wanted.placing.placement(header)
    if wanted.mavlink is not None and None in (wanted.placing.base, wanted.placing.map):
        raise UsageError(
            "--mavlink: expected --map, the bundle's world in north, east, down, and --base, "
            "the vehicle's forward, right, down in the camera"
        )
    if wanted.view:
        where = placed or Placement.of(header)
        yield "viewer", partial(RerunSink, None, header, where, lambda: odometer.image)
    # The options may be for the autopilot or the viewer alone; for neither, they are refused.
    for_records = wanted.format in PLACED or not (wanted.mavlink or wanted.view)
    yield (
        "records",
        partial(
            open_sink,
            wanted.output,
            wanted.format,
            header,
            placed if for_records else None,
            region=wanted.region,
            existing=wanted.existing,
            told=say,
        ),
    )
    if wanted.mavlink is not None and placed is not None:
        yield "messages", partial(MavlinkSink, wanted.mavlink, placed)
    if wanted.metrics is not None:
        yield "metrics", partial(MetricsSink, wanted.metrics, counts)
