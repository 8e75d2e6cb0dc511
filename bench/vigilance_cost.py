"""What watching a stream costs: a frame with the alarm and the checks of repetition, and without.

    python bench/vigilance_cost.py BUNDLE SOURCE [--json FILE]

The frame without has the same network less the nodes that only the statistics of familiarity need,
no factor of difficulty, and no stream checks. Both take turns on the same images, on one thread and
on two; there should be over 256, so that none is repeated. ``stream`` is the time of the checks
after the network, alone. The file's growth is that of the model.
"""

from __future__ import annotations

import argparse
from functools import partial
from itertools import islice
from pathlib import Path
from time import perf_counter
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import onnx
from onnx.utils import Extractor
from provenance import write_result
from rounds import figures, interleaved, ratio

from cvo_edge.bundle.format import FAMILIARITY
from cvo_edge.engine.loading import Bundle, read_bundle
from cvo_edge.input import frame_checks
from cvo_edge.input.frame import Frame
from cvo_edge.input.frame_checks import StreamChecks
from cvo_edge.input.repetition import Digest
from cvo_edge.input.sources import open_source
from cvo_edge.monitor.watch import StreamWatch
from cvo_edge.odometer import Odometer
from cvo_export.bundles.draft import model_spec

ROUNDS, WARM_UP = 400, 30


class _NoChecks(StreamChecks):
    """Stream checks that look at nothing."""

    def picture(self, *_: Any, **__: Any) -> tuple[()]:  # noqa: ANN401 - takes what others take
        return ()

    def times(self, *_: Any) -> tuple[()]:  # noqa: ANN401
        return ()


# Instead of the digest of an image, which only these checks need.
_NO_DIGEST = SimpleNamespace(of=lambda _: None)


def without_alarm(bundle: Bundle) -> Bundle:
    """Return the bundle with a network that does not tell how familiar an image is."""
    calibration = bundle.calibration
    kept = [spec.name for spec in calibration.model.outputs if spec.name not in FAMILIARITY]
    names = [spec.name for spec in calibration.model.inputs]
    content = bundle.model_bytes
    model = Extractor(onnx.load_from_string(content)).extract_model(names, kept)
    model_bytes: bytes = model.SerializeToString()
    spec = model_spec(model_bytes, calibration.model.opset, calibration.model.provider)
    outputs = {
        name: values for name, values in calibration.selftest.outputs.items() if name in kept
    }
    plain = msgspec.structs.replace(
        calibration,
        model=spec,
        alarm=None,
        difficulty=None,
        selftest=msgspec.structs.replace(calibration.selftest, outputs=outputs),
    )
    return Bundle.of(plain, model_bytes)


def frame_ms(bundle: Bundle, plain: Bundle, images: list[Any], threads: int) -> dict[str, Any]:
    """Time frames of both bundles in turn."""
    watched, bare = Odometer(bundle, threads=threads), Odometer(plain, threads=threads)
    bare._watch._checks = _NoChecks()  # noqa: SLF001 - no user wants this
    kept = np.empty_like(images[0])
    odometers = {"watched": watched, "bare": bare}

    def ready(name: str, number: int) -> None:
        np.copyto(kept, images[number % len(images)])
        vars(frame_checks)["Digest"] = Digest if name == "watched" else _NO_DIGEST

    ms = interleaved(
        {name: lambda _, one=one: one.step(kept) for name, one in odometers.items()},
        rounds=ROUNDS,
        warmup=WARM_UP,
        before={name: partial(ready, name) for name in odometers},
    )
    more = ms["watched"] - ms["bare"]
    return {
        "watched_ms": figures(ms["watched"]),
        "bare_ms": figures(ms["bare"]),
        "more_ms": float(np.median(more)),
        "ratio": ratio(ms["watched"], ms["bare"]),
    }


def stream_ms(bundle: Bundle, images: list[Any]) -> float:
    """Return the median time of all checks of a stream, without the network."""
    with Odometer(bundle, threads=1) as odometer:
        observations = [odometer.observe(image, 0) for image in images]
        observer = odometer._observer  # noqa: SLF001 - to time a part alone
        watch, spent = StreamWatch(observer, bundle.calibration), []
        for number in range(WARM_UP + ROUNDS):
            observation, frame = observations[number % len(images)], Frame(None, None, "", 0.0)
            begin = perf_counter()
            watch.judge(observation, watch.picture(observation.look, frame), number, frame, 0.0)
            spent.append(1e3 * (perf_counter() - begin))
    return float(np.median(spent[WARM_UP:]))


def main() -> None:
    """Print the figures; write them as JSON where asked."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("bundle", type=Path)
    parser.add_argument("source", help="images of the bundle's place, as for cvo-edge run")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    frames = islice(open_source(arguments.source), WARM_UP + ROUNDS)
    images = [frame.image for frame in frames if frame.image is not None]
    bundle = read_bundle(arguments.bundle)
    plain = without_alarm(bundle)
    report: dict[str, Any] = {
        "bundle": bundle.calibration.name,
        "more_kib": (len(bundle.model_bytes) - len(plain.model_bytes)) / 1024,
        "stream_ms": stream_ms(bundle, images),
        "threads": {str(threads): frame_ms(bundle, plain, images, threads) for threads in (1, 2)},
    }
    print(f"model      +{report['more_kib']:.0f} KiB")
    print(f"stream     {report['stream_ms']:.3f} ms")
    for threads, found in report["threads"].items():
        print(f"{threads} threads  +{found['more_ms']:.3f} ms, {found['ratio']}")
    if arguments.json:
        write_result(arguments.json, report)


if __name__ == "__main__":
    main()
