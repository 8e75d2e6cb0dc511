"""Read a bundle folder into a checked bundle, and open the engine that runs its model."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cvo_edge.bundle.format import MODEL_FILE, Calibration, ModelSpec, TensorSpec
from cvo_edge.bundle.reading import Check, check_model_file, read_calibration_file, read_model
from cvo_edge.engine.model_cache import CachedModel, ModelCache
from cvo_edge.engine.own_files import identity
from cvo_edge.engine.session import Session
from cvo_edge.errors import BundleMismatchError, ModelError, UsageError
from cvo_edge.given import given_path
from cvo_edge.heads import Head
from cvo_edge.heads.checked import checked_head
from cvo_edge.input import preprocess


@dataclass(frozen=True, eq=False, repr=False)
class Bundle:
    """A checked bundle, ready to run.

    Attributes
    ----------
    calibration
        The contents of ``calibration.json``.
    head
        The method's score and set, built from the calibration.
    model
        The model's bytes, whose sha256 matches the calibration, or the same model, optimised for
        this machine by a cache.
    """

    calibration: Calibration
    head: Head
    model: bytes | CachedModel

    @classmethod
    def of(cls, calibration: Calibration, model: bytes | CachedModel) -> Bundle:
        """Check a calibration against its method, as ``read_bundle`` does, and build a bundle."""
        return cls(calibration, checked_head(calibration), model)

    @property
    def model_bytes(self) -> bytes:
        """The model's bytes; raises UsageError if the bundle holds a cached model instead."""
        if isinstance(self.model, CachedModel):
            raise UsageError("bundle: holds a cached model only; read it without a cache")
        return self.model

    def __repr__(self) -> str:
        spec, calibration = self.calibration.model, self.calibration
        return (
            f"<Bundle {calibration.name!r}: {calibration.method}, {spec.precision} on "
            f"{spec.provider}>"
        )


def read_bundle(
    folder: str | os.PathLike[str],
    *,
    cache: ModelCache | None = None,
    check: Check | None = None,
) -> Bundle:
    """Read and check a bundle folder.

    Parameters
    ----------
    folder
        Folder with ``model.onnx`` and ``calibration.json``.
    cache
        Cache of models optimised for this machine; the first call for a model fills it. If it
        cannot be used, the bundle holds the model's bytes.
    check
        An additional check, e.g. of a signature; called before the model is read.

    Raises
    ------
    CalibrationFileError
        ``calibration.json`` is missing, not a regular file, malformed or altered.
    ModelError
        ``model.onnx`` is missing, not a regular file or too large.
    BundleMismatchError
        ``model.onnx`` is not the calibrated model, even if the cache holds that one, or its tensors
        do not match the method. ``check`` may raise other errors.
    """
    path = given_path(folder, "bundle")
    calibration, content = read_calibration_file(path)
    head = checked_head(calibration)
    if check is not None:
        check(path, calibration, content)
    cached = None if cache is None else cached_model(cache, calibration)
    if cache is not None and cached is not None:
        _check_original(path, calibration, cache, cached)
        return Bundle(calibration, head, cached)
    model = read_model(path, calibration)
    if cache is not None:
        cached = _cached_now(calibration, model, cache)
    return Bundle(calibration, head, model if cached is None else cached)


def cached_model(cache: ModelCache, calibration: Calibration) -> CachedModel | None:
    """Return the cached model of a calibration, for its provider, or None."""
    return cache.find(calibration.model.sha256, calibration.model.provider)


def _check_original(
    folder: Path, calibration: Calibration, cache: ModelCache, cached: CachedModel
) -> None:
    """Raise BundleMismatchError if the bundle's own model file is not the calibrated one.

    The cache entry that runs was checked separately; this check reports a replaced ``model.onnx``.
    A file that has not changed since its last check is not read again.
    """
    model = folder / MODEL_FILE
    if not cache.knows(cached, model):
        before = identity(model)
        check_model_file(folder, calibration)
        cache.remember(cached, model, before)


def _cached_now(calibration: Calibration, model: bytes, cache: ModelCache) -> CachedModel | None:
    """Build a cache entry; None if it cannot be stored or its results are not bit-identical."""
    new = cache.new_folder()
    if new is None:
        return None
    spec = calibration.model
    try:
        plain = open_session(model, 1, spec, keep_in=new)
        expected = plain.run(_feeds(spec.inputs))
    except (ModelError, BundleMismatchError):
        # The disk may be full. A model that the engine refuses is reported without the cache.
        cache.discard(new)
        return None
    # Two models in memory at once would set the peak of the whole run.
    del plain
    cache.keep(new, calibration.name, spec.sha256, spec.provider)
    cached = cached_model(cache, calibration)
    if cached is not None and not _same(cached, spec, expected):
        cache.forget(spec.sha256, spec.provider)
        return None
    return cached


def _same(cached: CachedModel, spec: ModelSpec, expected: dict[str, np.ndarray]) -> bool:
    try:
        found = open_session(cached, 1, spec).run(_feeds(spec.inputs))
    except (ModelError, BundleMismatchError):
        return False
    return all(np.array_equal(found[name], values) for name, values in expected.items())


def _feeds(inputs: tuple[TensorSpec, ...]) -> dict[str, np.ndarray]:
    """Return values for every input: the self-test image, and ones for other inputs."""
    return {
        spec.name: preprocess.selftest_image(*spec.shape[1:3])[np.newaxis]
        if spec.dtype == "uint8"
        else np.ones(spec.shape, np.float32)
        for spec in inputs
    }


def open_session(
    model: bytes | CachedModel,
    threads: int | None,
    expected: ModelSpec,
    *,
    spinning: bool = True,
    at_once: int = 1,
    keep_in: Path | None = None,
) -> Session:
    """Open a session of the provider that the calibration names.

    ``at_once`` is the number of threads that call the session concurrently; see ``Session`` for the
    other parameters. Raises BundleMismatchError if a cached model was built from another model.
    """
    if isinstance(model, CachedModel) and (model.model_sha256, model.provider) != (
        expected.sha256,
        expected.provider,
    ):
        raise BundleMismatchError(
            f"cached model: expected sha256 {expected.sha256} for {expected.provider}, found "
            f"{model.model_sha256} for {model.provider}"
        )
    if expected.provider == "openvino":
        # Imported here because the package is optional and large.
        from cvo_edge.engine.openvino import OpenvinoSession

        return OpenvinoSession(model, threads, expected, at_once=at_once, keep_in=keep_in)
    return Session(model, threads, expected, spinning=spinning, keep_in=keep_in)
