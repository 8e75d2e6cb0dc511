"""Messages of rclpy from the nested dicts of ``cvo_edge.output.messages``."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any

Load = Callable[[str], Any]


def message_class(name: str) -> Any:
    """Return the class of ``package/msg/Name`` or ``package/Name``."""
    words = name.split("/")
    return getattr(import_module(f"{words[0]}.msg"), words[-1])


def filled(name: str, content: Mapping[str, Any], load: Load = message_class) -> Any:
    """Return a message of a type from its fields; others keep their default."""
    message = load(name)()
    kinds = message.get_fields_and_field_types()
    for field, value in content.items():
        setattr(message, field, _value(kinds[field], value, load))
    return message


def _value(kind: str, value: Any, load: Load) -> Any:
    if isinstance(value, Mapping):
        return filled(kind, value, load)
    if kind.startswith("sequence<") and "/" in kind:
        inner = kind.removeprefix("sequence<").removesuffix(">")
        return [filled(inner, each, load) for each in value]
    # The level of diagnostics is a byte.
    return bytes([value]) if kind == "octet" else value
