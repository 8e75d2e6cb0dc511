"""Which of a method's scores and sides a calibration may choose from."""

from __future__ import annotations

from collections.abc import Sequence

from msgspec.structs import replace

from cvo_edge.errors import UsageError
from cvo_edge.heads import Candidate
from cvo_edge.vocabulary import Sides


def selected(
    candidates: Sequence[Candidate], score: str | None, sides: Sides | None
) -> tuple[Candidate, ...]:
    """Return the candidates with this score and these sides; None leaves the choice open.

    Raises UsageError for a score or sides that the method does not have.
    """
    names = list(dict.fromkeys(candidate.score for candidate in candidates))
    if score is not None and score not in names:
        raise UsageError(f"score: expected one of {', '.join(names)}, found {score}")
    kept = [c for c in candidates if score in (None, c.score)]
    if sides is None or (sides == "symmetric" and "sides" not in _names(kept[0])):
        return tuple(kept)
    if any("sides" not in _names(candidate) for candidate in kept):
        raise UsageError(f"sides: expected symmetric, this method's only choice, found {sides}")
    return tuple(c._replace(parameters=replace(c.parameters, sides=sides)) for c in kept)


def _names(candidate: Candidate) -> tuple[str, ...]:
    return candidate.parameters.__struct_fields__
