"""A bundle folder -> a checked bundle, and the engine that runs its model."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cvo_edge.bundle.format import MODEL_FILE, Calibration, ModelSpec, TensorSpec
from cvo_edge.bundle.reading import Check, check_model_file, read_calibration_file, read_model
from cvo_edge.engine.model_cache import ModelCache, PreparedModel, identity
from cvo_edge.engine.session import Session
from cvo_edge.errors import BundleMismatchError, ModelError, UsageError
from cvo_edge.heads import Head
from cvo_edge.heads.checked import checked_head
from cvo_edge.input import preprocess


@dataclass(frozen=True, eq=False, repr=False)
class Bundle:
    """A checked bundle, ready to run.

    Attributes
    ----------
    calibration
        What ``calibration.json`` says.
    head
        The method's score and set, made from it.
    model
        The bytes whose sha256 the calibration names, or the form of that model that a cache has
        prepared for this machine.
    """

    calibration: Calibration
    head: Head
    model: bytes | PreparedModel

    @classmethod
    def of(cls, calibration: Calibration, model: bytes | PreparedModel) -> Bundle:
        """Check a calibration against its method; raises as ``read_bundle``."""
        return cls(calibration, checked_head(calibration), model)

    @property
    def model_bytes(self) -> bytes:
        """The model itself; raises UsageError where the bundle holds a prepared form of it."""
        if isinstance(self.model, PreparedModel):
            raise UsageError("bundle: expected one read without a cache, found a prepared model")
        return self.model

    def __repr__(self) -> str:
        spec, calibration = self.calibration.model, self.calibration
        return (
            f"<Bundle {calibration.name}: {calibration.method}, {spec.precision} on "
            f"{spec.provider}, sha256 {spec.sha256[:12]}...>"
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
        With ``model.onnx`` and ``calibration.json``.
    cache
        Takes the model from this cache, prepared for this machine, and puts it there the first
        time. The bundle holds the model's bytes where the cache cannot be used, and for a provider
        other than onnxruntime.
    check
        What else must hold, e.g. a signature; called before the model is read.

    Raises
    ------
    CalibrationFileError
        ``calibration.json`` is missing, not a regular file, malformed or altered.
    ModelError
        ``model.onnx`` is missing, not a regular file or too large.
    BundleMismatchError
        The model is not the one that was calibrated, whatever the cache holds, or its tensors are
        not those of the method; and what ``check`` raises.
    """
    path = Path(folder)
    calibration, content = read_calibration_file(path)
    head = checked_head(calibration)
    if check is not None:
        check(path, calibration, content)
    prepared = None if cache is None else prepared_model(cache, calibration)
    if cache is not None and prepared is not None:
        _check_original(path, calibration, cache, prepared)
        return Bundle(calibration, head, prepared)
    model = read_model(path, calibration)
    if cache is not None and calibration.model.provider == "onnxruntime":
        prepared = _prepared_now(calibration, model, cache)
    return Bundle(calibration, head, model if prepared is None else prepared)


def prepared_model(cache: ModelCache, calibration: Calibration) -> PreparedModel | None:
    """Return what the cache has of a calibration's model; only models of onnxruntime are cached."""
    if calibration.model.provider != "onnxruntime":
        return None
    return cache.find(calibration.model.sha256)


def _check_original(
    folder: Path, calibration: Calibration, cache: ModelCache, prepared: PreparedModel
) -> None:
    """Raise BundleMismatchError where the bundle's own model file is not the calibrated one.

    What runs is the cache's entry, whose files were checked: this tells of a model that was
    swapped. A file that has not changed since its digest was last taken is not read again.
    """
    model = folder / MODEL_FILE
    if not cache.knows(prepared, model):
        before = identity(model)
        check_model_file(folder, calibration)
        cache.remember(prepared, model, before)


def _prepared_now(
    calibration: Calibration, model: bytes, cache: ModelCache
) -> PreparedModel | None:
    """Build the entry; None where it cannot be kept or does not compute exactly the same."""
    new = cache.new_folder()
    if new is None:
        return None
    spec = calibration.model
    try:
        plain = Session(model, 1, spec, keep_in=new)
        expected = plain.run(_feeds(spec.inputs))
    except (ModelError, BundleMismatchError):
        # The disk may be full. A model that is itself refused is refused again without the cache.
        cache.discard(new)
        return None
    # Two models in memory at once would be the peak of the whole run.
    del plain
    cache.keep(new, calibration.name, spec.sha256)
    prepared = cache.find(spec.sha256)
    if prepared is not None and not _same(prepared, spec, expected):
        cache.forget(spec.sha256)
        return None
    return prepared


def _same(prepared: PreparedModel, spec: ModelSpec, expected: dict[str, np.ndarray]) -> bool:
    try:
        found = Session(prepared, 1, spec).run(_feeds(spec.inputs))
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
    model: bytes | PreparedModel,
    threads: int | None,
    expected: ModelSpec,
    *,
    spinning: bool = True,
    at_once: int = 1,
) -> Session:
    """Open a session of the provider that a calibration is about.

    ``at_once`` is the number of threads that will call it at the same time; the rest as in
    ``Session``. Raises BundleMismatchError for a prepared model that was made of another model.
    """
    if isinstance(model, PreparedModel) and (model.model_sha256, "onnxruntime") != (
        expected.sha256,
        expected.provider,
    ):
        raise BundleMismatchError(
            f"prepared model: expected one of {expected.sha256} on {expected.provider}, found one "
            f"of {model.model_sha256} on onnxruntime"
        )
    if expected.provider == "openvino" and not isinstance(model, PreparedModel):
        # An optional package, and not a small one.
        from cvo_edge.engine.openvino import OpenvinoSession

        return OpenvinoSession(model, threads, expected, at_once=at_once)
    return Session(model, threads, expected, spinning=spinning)
