"""The engine that a calibration is about -> its session."""

from __future__ import annotations

from cvo_edge.artifact import ModelSpec
from cvo_edge.errors import BundleMismatchError
from cvo_edge.prepared import Prepared
from cvo_edge.session import Session


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
        from cvo_edge.openvino_session import OpenvinoSession

        return OpenvinoSession(model, threads, expected, at_once=at_once)
    return Session(model, threads, expected, spinning=spinning)
