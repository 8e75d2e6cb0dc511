"""All that can be trained, by name: the methods, and the baselines they are compared with."""

from __future__ import annotations

from typing import Any, Union

import msgspec
from msgspec import Struct

from cvo_export.networks.baselines import BASELINES
from cvo_export.networks.heads import METHODS, Method

TRAINABLE: dict[str, Method] = METHODS | BASELINES


def options_of(values: Any) -> Struct:  # noqa: ANN401 - what JSON holds
    """Return a method's options as its own struct; ``method`` names it.

    Raises msgspec.ValidationError where there is no such method, or an option is not its own.
    """
    known: Any = Union[tuple(method.config for method in TRAINABLE.values())]  # noqa: UP007
    options: Struct = msgspec.convert(values, known)
    return options
