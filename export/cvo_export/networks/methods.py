"""All trainable methods and baselines, by name."""

from __future__ import annotations

from typing import Any, Union

import msgspec
from msgspec import Struct

from cvo_export.networks.baselines import BASELINES
from cvo_export.networks.heads import METHODS, Method

TRAINABLE: dict[str, Method] = METHODS | BASELINES


def options_of(values: Any) -> Struct:  # noqa: ANN401 - what JSON holds
    """Convert a JSON object to the options struct that its field ``method`` names.

    Raises msgspec.ValidationError for an unknown method or an option the method does not have.
    """
    known: Any = Union[tuple(method.config for method in TRAINABLE.values())]  # noqa: UP007
    options: Struct = msgspec.convert(values, known)
    return options
