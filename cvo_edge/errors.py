"""All errors of the package, each with its exit code.

::

    CvoError                     1   base class, never raised itself; 1 also means a defect
    |-- UsageError               2   an invalid parameter, option or call
    |-- CalibrationFileError     3   calibration.json missing, malformed, unknown version
    |-- ModelError               4   model.onnx missing, refused or failing
    |-- BundleMismatchError      5   model and calibration do not belong together
    |-- SourceError              6   source or data set cannot be read, or ended early
    |-- SinkError                7   output cannot be written
    +-- GateError                8   a gate failed: latency, memory, coverage, parity, self-test

Every message is one line that says what was expected, what was found and where.
"""

from __future__ import annotations

from typing import ClassVar

_LONGEST = 1000


class CvoError(Exception):
    """Base class of all errors that this package raises deliberately.

    Attributes
    ----------
    exit_code
        Exit code of both command lines for this class.
    """

    exit_code: ClassVar[int] = 1

    def __init__(self, message: str) -> None:
        # The message may quote a line of a megabyte.
        super().__init__(message if len(message) <= _LONGEST else f"{message[: _LONGEST - 3]}...")


def printable(text: str) -> str:
    """Return a text as one line without control characters, e.g. from a path."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


class UsageError(CvoError):
    """A parameter, option or call is invalid, e.g. a confidence that the bundle does not store."""

    exit_code = 2


class CalibrationFileError(CvoError):
    """``calibration.json`` is missing, malformed, altered or of an unknown version."""

    exit_code = 3


class ModelError(CvoError):
    """``model.onnx`` is missing, refused by the inference engine, or fails while running."""

    exit_code = 4


class BundleMismatchError(CvoError):
    """Model and calibration do not belong together: digest, inputs or outputs disagree."""

    exit_code = 5


class SourceError(CvoError):
    """Images or poses are missing, cannot be read, or ended early."""

    exit_code = 6


class SinkError(CvoError):
    """An output cannot be written."""

    exit_code = 7


class GateError(CvoError):
    """A limit set by the caller, or a built-in check, was not met."""

    exit_code = 8
