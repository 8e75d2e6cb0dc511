"""A bundle folder -> the bundle, with its model as a cache has it prepared for this machine."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cvo_edge.bundle.format import MODEL_FILE, Calibration, ModelSpec, TensorSpec
from cvo_edge.bundle.reading import Bundle, Check, check_model_file, read_bundle, read_calibration
from cvo_edge.engine.model_cache import ModelCache, Prepared, identity
from cvo_edge.engine.session import Session
from cvo_edge.errors import BundleMismatchError, ModelError
from cvo_edge.input import preprocess


@dataclass(frozen=True)
class PreparedBundle:
    """A bundle whose model comes from a cache: the calibration, and what was made of its model."""

    calibration: Calibration
    prepared: Prepared


def load_bundle(
    folder: Path, cache: ModelCache, check: Check | None = None
) -> Bundle | PreparedBundle:
    """Read and check a bundle folder; its model as the cache has it, or puts it there now.

    The bundle as it is where the cache cannot be used, or its model is of another provider. Errors
    are those of ``read_bundle``: a model file that is not the calibrated one is refused, whatever
    the cache holds. The digest of one that has not changed since it was last taken, as the system
    has it, is not taken again.
    """
    calibration = read_calibration(folder, check)
    found = found_in(cache, calibration)
    if found is not None:
        model = folder / MODEL_FILE
        # What runs is the entry, whose files were checked: this is for whoever swaps the model.
        if not cache.knows(found.prepared, model):
            before = identity(model)
            check_model_file(folder, calibration)
            cache.remember(found.prepared, model, before)
        return found
    bundle = read_bundle(folder, check)
    if calibration.model.provider != "onnxruntime":
        return bundle
    prepared = _prepared_now(bundle, cache)
    return bundle if prepared is None else PreparedBundle(bundle.calibration, prepared)


def found_in(cache: ModelCache, calibration: Calibration) -> PreparedBundle | None:
    """Return what the cache has of a calibration's model; of onnxruntime's alone it has any."""
    if calibration.model.provider != "onnxruntime":
        return None
    prepared = cache.find(calibration.model.sha256)
    return None if prepared is None else PreparedBundle(calibration, prepared)


def _prepared_now(bundle: Bundle, cache: ModelCache) -> Prepared | None:
    """Build the entry; None where it cannot be kept, or does not compute the very same."""
    new = cache.new_folder()
    if new is None:
        return None
    model = bundle.calibration.model
    try:
        plain = Session(bundle.model_bytes, 1, model, keep_in=new)
        expected = plain.run(_feeds(model.inputs))
    except (ModelError, BundleMismatchError):
        # The disk may be full. A model that is itself refused says so when it is loaded without.
        cache.discard(new)
        return None
    # Two models in memory at once would be the peak of the whole run.
    del plain
    cache.keep(new, bundle.calibration.name, model.sha256)
    prepared = cache.find(model.sha256)
    if prepared is not None and not _same(prepared, bundle, expected):
        cache.forget(model.sha256)
        return None
    return prepared


def _same(prepared: Prepared, bundle: Bundle, expected: dict[str, np.ndarray]) -> bool:
    model = bundle.calibration.model
    try:
        found = Session(prepared, 1, model).run(_feeds(model.inputs))
    except (ModelError, BundleMismatchError):
        return False
    return all(np.array_equal(found[name], values) for name, values in expected.items())


def _feeds(inputs: tuple[TensorSpec, ...]) -> dict[str, np.ndarray]:
    """Values for every input: rings as the image, ones elsewhere."""
    return {
        spec.name: preprocess.selftest_image(*spec.shape[1:3])[np.newaxis]
        if spec.dtype == "uint8"
        else np.ones(spec.shape, np.float32)
        for spec in inputs
    }


def open_session(
    model: bytes | Prepared,
    threads: int,
    expected: ModelSpec,
    *,
    spinning: bool = True,
    at_once: int = 1,
) -> Session:
    """Open a session of the provider that a calibration is about.

    ``at_once`` is the number of threads that will call it at the same time; the rest as in
    ``Session``. Raises BundleMismatchError where what a cache has is not of this very model.
    """
    if isinstance(model, Prepared) and (model.model_sha256, "onnxruntime") != (
        expected.sha256,
        expected.provider,
    ):
        raise BundleMismatchError(
            f"prepared model: expected that of {expected.sha256} on {expected.provider}, found "
            f"that of {model.model_sha256} on onnxruntime"
        )
    if expected.provider == "openvino" and not isinstance(model, Prepared):
        # An optional package, and not a small one.
        from cvo_edge.engine.openvino import OpenvinoSession

        return OpenvinoSession(model, threads, expected, at_once=at_once)
    return Session(model, threads, expected, spinning=spinning)
