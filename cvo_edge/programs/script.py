"""The script that one would write with onnxruntime alone, beside ``run`` on the same files.

Both turn the whole source into JSON lines. The script reads with OpenCV, resizes, infers with
onnxruntime's default settings but for the number of threads, and writes what comes out. It makes
no checks and no intervals, and solves for no pose.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter, sleep
from typing import Any, NamedTuple

import cv2
import numpy as np
import onnxruntime
from numpy.typing import NDArray

from cvo_edge.bundle.format import MODEL_FILE
from cvo_edge.engine.cores import checked_threads
from cvo_edge.engine.model_cache import ModelCache
from cvo_edge.errors import SinkError, SourceError, UsageError
from cvo_edge.estimate import PoseInterval
from cvo_edge.input.capture import shown
from cvo_edge.input.image_files import ImageFiles
from cvo_edge.input.pipes import names_pipe
from cvo_edge.input.sources import names_camera, open_source
from cvo_edge.odometer import Odometer
from cvo_edge.output.records import header_of
from cvo_edge.output.sinks import Sink
from cvo_edge.programs.run import RunSummary
from cvo_edge.programs.run import run as run_frames

ROUNDS, WARM_UP = 5, 1
# onnxruntime's threads still spin for a while after a call.
_PAUSE_S = 0.05
# Of larger outputs (those of a solver), the script writes the mean only, which favours it.
_FEW = 64
SCRIPT, COMPARED = "script", ("latency", "throughput")

Image = NDArray[np.uint8]


class Passed(NamedTuple):
    """One pass over the source: its frames, and the times of the first record and of all, ms."""

    frames: int
    first_ms: float
    whole_ms: float


Pass = Callable[[], Passed]


def check_read_again(source: str | None) -> str:
    """Return a source of files; raises UsageError for one that cannot be read twice, or none."""
    expected = "--against-script: expected a SOURCE of images or a video, which is read repeatedly"
    if source is None:
        raise UsageError(f"{expected}, found none")
    if names_camera(source) or names_pipe(source):
        raise UsageError(f"{expected}, found a camera or pipe: {shown(source)}")
    return source


def announcement(source: str, frames: int | None, fps: float) -> str:
    """Return how long the passes take, from the rate of one of the modes."""
    passes, length = (1 + len(COMPARED)) * (WARM_UP + ROUNDS), open_source(source).length
    counts = [count for count in (length, frames) if count is not None]
    if not counts:
        return f"{passes} passes over the source"
    return (
        f"{passes} passes over {min(counts)} frames, about {passes * min(counts) / fps:.0f} s; "
        "--frames takes fewer"
    )


def against_script(
    bundle: Path,
    source: str,
    *,
    frames: int | None = None,
    threads: int | None = None,
    rounds: int = ROUNDS,
    cache: ModelCache | None = None,
) -> dict[str, Any]:
    """Time whole passes over a source: the script, and ``run`` in two modes, in turns.

    ``frames`` limits a pass. Ratios are those within a round, because the speed of a machine
    changes. Raises UsageError for a source that cannot be read twice, SourceError for one without
    an image, SinkError, and the errors of ``Odometer.load``.
    """
    check_read_again(source)
    threads = checked_threads(threads)
    with ExitStack() as stack:
        folder = Path(stack.enter_context(TemporaryDirectory(prefix="cvo-edge-bench-")))
        passes: dict[str, Pass] = {}
        for mode in COMPARED:
            odometer = Odometer.load(bundle, threads=threads, mode=mode, cache=cache)
            stack.enter_context(odometer)
            target = folder / f"{mode}.jsonl"
            passes[mode] = _this(odometer, source, target, frames, threads)
        script = _script(bundle, odometer, source, folder / "script.jsonl", frames, threads)
        found = _in_turns({SCRIPT: script, **passes}, rounds)
    counted, scripted = found[COMPARED[0]][0].frames, found[SCRIPT][0].frames
    if not scripted:
        raise SourceError(f"{shown(source)}: expected images, found none that OpenCV reads")
    return {
        "frames": counted,
        "script_frames": scripted,
        "rounds": rounds,
        "threads": threads,
        "solves": odometer.head.solves,
        **{name: _figures(passed, found[SCRIPT], counted) for name, passed in found.items()},
    }


def _in_turns(passes: Mapping[str, Pass], rounds: int) -> dict[str, list[Passed]]:
    """Run all passes once per round, each round beginning with another one."""
    found: dict[str, list[Passed]] = {name: [] for name in passes}
    names = list(passes)
    for number in range(WARM_UP + rounds):
        first = number % len(names)
        for name in (*names[first:], *names[:first]):
            passed = passes[name]()
            sleep(_PAUSE_S)
            if number >= WARM_UP:
                found[name].append(passed)
    return found


def _figures(passed: list[Passed], script: list[Passed], frames: int) -> dict[str, Any]:
    ratios = [a.whole_ms / b.whole_ms for a, b in zip(passed, script, strict=True)]
    return {
        "ms_per_frame": _spread([each.whole_ms / frames for each in passed]),
        "first_record_ms": _spread([each.first_ms for each in passed]),
        "over_script": _spread(ratios),
    }


def _spread(values: list[float]) -> dict[str, float]:
    named = {"median": float(np.median(values)), "least": min(values), "most": max(values)}
    return {name: round(value, 4) for name, value in named.items()}


def _this(odometer: Odometer, source: str, target: Path, frames: int | None, threads: int) -> Pass:
    """Return a pass of what ``run`` does."""
    header = header_of(odometer.calibration, odometer.chart, odometer.confidence, odometer.scope)

    def run() -> Passed:
        begin = perf_counter()
        first: list[float] = []
        summary = RunSummary(odometer.chart.dof, odometer.confidence, odometer.scope)
        with Sink(str(target), "jsonl", header) as sink:

            def write(estimate: PoseInterval) -> None:
                sink.write(estimate)
                if not first:
                    first.append(perf_counter() - begin)

            opened = open_source(source, threads=threads)
            run_frames(odometer, opened, write, summary=summary, max_frames=frames)
        return _passed(summary.frames, begin, first)

    return run


def _script(
    bundle: Path, odometer: Odometer, source: str, target: Path, frames: int | None, threads: int
) -> Pass:
    """Return a pass of the script."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    engine = onnxruntime.InferenceSession(
        (bundle / MODEL_FILE).read_bytes(), options, providers=["CPUExecutionProvider"]
    )
    spec = odometer.calibration.preprocess
    size = spec.width, spec.height
    others = dict(odometer.head.extra_inputs(0))

    def run() -> Passed:
        begin, count = perf_counter(), 0
        first: list[float] = []
        with target.open("w") as stream:
            for image in islice(_images(source, threads), frames):
                if image is None:
                    continue
                small = cv2.cvtColor(cv2.resize(image, size), cv2.COLOR_BGR2RGB)
                outputs = engine.run(None, {"image": small[np.newaxis], **others})
                stream.write(json.dumps([_written(values) for values in outputs]) + "\n")
                count += 1
                if not first:
                    first.append(perf_counter() - begin)
        return _passed(count, begin, first)

    def whole() -> Passed:
        try:
            return run()
        except OSError as error:
            raise SinkError(f"{target}: cannot be written: {error.strerror}") from None

    return whole


def _passed(frames: int, begin: float, first: list[float]) -> Passed:
    whole_ms = 1e3 * (perf_counter() - begin)
    return Passed(frames, 1e3 * first[0] if first else whole_ms, whole_ms)


def _written(values: NDArray[Any]) -> Any:  # noqa: ANN401 - nested lists, or a number
    return values.tolist() if values.size <= _FEW else float(values.mean())


def _images(source: str, threads: int) -> Iterator[Image | None]:
    """Yield the images as a script reads them, None for one that OpenCV refuses.

    Which files they are is taken from ``open_source``.
    """
    opened = open_source(source, threads=threads)
    if isinstance(opened, ImageFiles):
        return map(cv2.imread, opened.paths)  # type: ignore[arg-type]
    return _video_images(source, threads)


def _video_images(source: str, threads: int) -> Iterator[Image]:
    video = cv2.VideoCapture(source, cv2.CAP_FFMPEG, [cv2.CAP_PROP_N_THREADS, threads])
    try:
        while (read := video.read())[0]:
            yield np.asarray(read[1], np.uint8)
    finally:
        video.release()


def script_lines(found: Mapping[str, Any]) -> Iterator[str]:
    """Yield what was found, and who is faster."""
    rounds, threads = found["rounds"], found["threads"]
    yield (
        f"files to records beside a script of ten lines (cv2.imread, resize, onnxruntime, json), "
        f"{threads} threads, {found['frames']} frames, medians of {rounds} rounds in turns:"
    )
    yield f"{'':<12}{'ms per frame':>14}{'first record, ms':>18}  this over the script"
    for name in (SCRIPT, *COMPARED):
        row = found[name]
        ratio = row["over_script"]
        said = ""
        if name != SCRIPT:
            spread = f"({ratio['least']:.2f} to {ratio['most']:.2f})"
            said = f"  {ratio['median']:.3f} {spread}: {verdict(ratio)}"
        times = f"{row['ms_per_frame']['median']:>14.3f}{row['first_record_ms']['median']:>18.1f}"
        yield f"{name:<12}{times}{said}"
    if (unread := found["frames"] - found["script_frames"]) > 0:
        yield f"the script leaves out {unread} frames, which OpenCV does not read"
    yield "the script makes no checks and no intervals" + (
        "; it solves for no pose, and writes the means of the network's large outputs"
        if found["solves"]
        else ""
    )


def verdict(ratio: Mapping[str, float]) -> str:
    """Return who is faster, by the ratios of all rounds."""
    if ratio["most"] < 1.0:
        return "cvo-edge is faster"
    return "the script is faster" if ratio["least"] > 1.0 else "no clear difference"
