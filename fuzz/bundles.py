"""Mutated models and calibration files, with original or recomputed digests."""

from __future__ import annotations

import hashlib
import json
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import onnx
import onnxruntime

from cvo_edge.bundle.format import CALIBRATION_FILE, MODEL_FILE
from cvo_edge.bundle.reading import read_calibration
from cvo_edge.engine.loading import read_bundle
from cvo_edge.errors import BundleMismatchError, CalibrationFileError, CvoError, ModelError
from cvo_edge.input.preprocess import model_input, selftest_image
from fuzz.mutate import Generator, changed_bytes, changed_document, with_digest
from fuzz.trials import Tally, command, in_parallel

ARTIFACTS = Path(__file__).resolve().parent.parent / "calibration_artifacts"
# The smallest bundle of each method, quantised, and a float32 bundle for the other operators.
BUNDLES = tuple(
    ARTIFACTS / f"synthetic-room-{name}"
    for name in ("cjp-int8", "csp-int8", "mcqr-int8", "scr-int8", "cjp")
)
# Accepted exit codes of a bundle with matching digests: 0 if it passes its self-test, otherwise the
# codes for invalid files and for a failed self-test.
_PERMITTED = (0, 3, 4, 5, 8)


@contextmanager
def _copy(number: int) -> Iterator[tuple[Path, Generator]]:
    with tempfile.TemporaryDirectory() as folder:
        source = BUNDLES[number % len(BUNDLES)]
        yield (
            Path(shutil.copytree(source, Path(folder) / "bundle")),
            np.random.default_rng([2026, number]),
        )


def models(count: int) -> Tally:
    """Change bytes of ``model.onnx``; each must be refused before the engine reads it."""

    def trial(number: int) -> tuple[str, str | None]:
        with _copy(number) as (bundle, generator):
            path = bundle / MODEL_FILE
            path.write_bytes(changed_bytes(path.read_bytes(), generator))
            return _refused(bundle, (BundleMismatchError, ModelError))

    return in_parallel(trial, count)


def calibrations(count: int) -> Tally:
    """Change bytes or values of ``calibration.json``; each must be refused."""

    def trial(number: int) -> tuple[str, str | None]:
        with _copy(number) as (bundle, generator):
            path = bundle / CALIBRATION_FILE
            content = _changed(path, _changed_values, 0.5, generator)
            path.write_bytes(content)
            return _refused(bundle, (CalibrationFileError,))

    return in_parallel(trial, count)


def _refused(bundle: Path, expected: tuple[type[CvoError], ...]) -> tuple[str, str | None]:
    try:
        read_bundle(bundle)
    except expected as error:
        many = "more than one line" if "\n" in str(error) else None
        return f"exit code {error.exit_code}", many
    except Exception as error:  # noqa: BLE001 - any other exception is a finding
        return "error", repr(error)
    return "accepted", "accepted"


def models_that_fit(count: int) -> Tally:
    """Change a model, recompute all digests and run ``verify``."""

    def trial(number: int) -> tuple[str, str | None]:
        with _copy(number) as (bundle, generator):
            path = bundle / MODEL_FILE
            content = _changed(path, _changed_graph, 0.75, generator)
            path.write_bytes(content)
            calibration = bundle / CALIBRATION_FILE
            document = json.loads(calibration.read_bytes())
            document["model"]["sha256"] = hashlib.sha256(content).hexdigest()
            calibration.write_bytes(with_digest(json.dumps(document).encode()))
            return _verified(bundle)

    return in_parallel(trial, count)


def calibrations_that_fit(count: int) -> Tally:
    """Change ``calibration.json``, recompute its digest and run ``verify``."""

    def trial(number: int) -> tuple[str, str | None]:
        with _copy(number) as (bundle, generator):
            path = bundle / CALIBRATION_FILE
            content = _changed(path, _changed_values, 0.75, generator)
            path.write_bytes(with_digest(content))
            return _verified(bundle)

    return in_parallel(trial, count)


def _changed(
    path: Path, inside: Callable[[bytes, Generator], bytes], share: float, generator: Generator
) -> bytes:
    """Return a file's changed content: by ``inside`` with probability ``share``, else by bytes."""
    change = inside if generator.random() < share else changed_bytes
    return change(path.read_bytes(), generator)


def _changed_values(content: bytes, generator: Generator) -> bytes:
    """Return a document with changed values, keys or elements."""
    return changed_document(json.loads(content), generator)


def _verified(bundle: Path) -> tuple[str, str | None]:
    ended = command(["verify", bundle, "--threads", 1, "--timeout", 20])
    finding = ended.misbehaviour(_PERMITTED)
    if ended.code == 0 and not _answers_as_expected(bundle):
        finding = "accepted, but its outputs differ from its self-test"
    return f"exit code {ended.code}", finding


def _answers_as_expected(bundle: Path) -> bool:
    """Return whether onnxruntime alone reproduces the outputs of a bundle's self-test."""
    calibration = read_calibration(bundle)
    test, spec = calibration.selftest, calibration.preprocess
    image = selftest_image(test.height, test.width)
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4
    options.add_session_config_entry("session.x64quantprecision", "1")
    session = onnxruntime.InferenceSession(
        (bundle / MODEL_FILE).read_bytes(), options, providers=["CPUExecutionProvider"]
    )
    feeds = {"image": model_input(image, spec.height, spec.width, spec.crop)}
    outputs = session.run(list(test.outputs), feeds)
    return all(
        np.allclose(output.ravel(), expected, rtol=0.0, atol=test.tolerance)
        for output, expected in zip(outputs, test.outputs.values(), strict=True)
    )


def _changed_graph(content: bytes, generator: Generator) -> bytes:
    """Return a model that still parses, with changed nodes, attributes, weights or shapes."""
    model = onnx.load_from_string(content)
    before = model.SerializeToString()
    while (after := model.SerializeToString()) == before:
        _change(model.graph, generator)
    return bytes(after)


def _change(graph: onnx.GraphProto, generator: Generator) -> None:
    """Make up to three random changes; a change that does not apply is skipped."""
    for _ in range(int(generator.integers(1, 4))):
        kind = int(generator.integers(6))
        node = graph.node[int(generator.integers(len(graph.node)))]
        weights = graph.initializer[int(generator.integers(len(graph.initializer)))]
        if kind == 0:
            values = bytearray(weights.raw_data)
            if values:
                values[int(generator.integers(len(values)))] ^= 1 << int(generator.integers(8))
                weights.raw_data = bytes(values)
        elif kind == 1 and weights.dims:
            place = int(generator.integers(len(weights.dims)))
            weights.dims[place] = int(generator.choice([0, 1, 2**31, 2**62, -1]))
        elif kind == 2 and node.input:
            names = [name for other in graph.node for name in other.output]
            node.input[int(generator.integers(len(node.input)))] = str(generator.choice(names))
        elif kind == 3 and node.attribute:
            attribute = node.attribute[int(generator.integers(len(node.attribute)))]
            if attribute.ints:
                place = int(generator.integers(len(attribute.ints)))
                attribute.ints[place] = int(generator.choice([0, -1, 7, 2**31, 2**62]))
            elif attribute.type == onnx.AttributeProto.INT:
                attribute.i = int(generator.choice([0, -1, 7, 2**31, 2**62]))
            elif attribute.type == onnx.AttributeProto.FLOAT:
                attribute.f = float(generator.choice([np.nan, np.inf, -1.0, 1e38]))
        elif kind == 4:
            node.op_type = str(generator.choice(["Loop", "Sin", "Expand", "Tile", "Conv", "X", ""]))
        else:
            graph.node.remove(node)
