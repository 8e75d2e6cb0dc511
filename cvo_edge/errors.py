"""Everything that can go wrong, one exit code each.

::

    CvoError                     1   a defect of ours, never raised as such
    |-- UsageError               2   the caller asked for what cannot be
    |-- CalibrationFileError     3   calibration.json missing, malformed, unknown version
    |-- ModelError               4   model.onnx missing, refused or failing
    |-- BundleMismatchError      5   model and calibration do not belong together
    |-- SourceError              6   source or data set cannot be read or ended early
    |-- SinkError                7   output cannot be written
    +-- GateError                8   a gate failed: latency, memory, coverage, parity, self-test

Every message is one line that says what was expected, what was found, and where.
"""

from __future__ import annotations

from typing import ClassVar

_LONGEST = 1000


class CvoError(Exception):
    """Base of every error this package raises on purpose.

    Attributes
    ----------
    exit_code
        What both command lines return to the shell for this class.
    """

    exit_code: ClassVar[int] = 1

    def __init__(self, message: str) -> None:
        # What was found may be a megabyte in one line.
        super().__init__(message if len(message) <= _LONGEST else f"{message[: _LONGEST - 3]}...")


def printable(text: str) -> str:
    """Return a text as one line that does nothing to a terminal, whatever a path in it holds."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


class UsageError(CvoError):
    """A parameter, option or call that cannot be served, e.g. a confidence that is not stored."""

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
    """Images or poses cannot be read, ended early, or there are none."""

    exit_code = 6


class SinkError(CvoError):
    """An output cannot be written."""

    exit_code = 7


class GateError(CvoError):
    """A limit that the caller set, or a check of ours, was not met."""

    exit_code = 8
