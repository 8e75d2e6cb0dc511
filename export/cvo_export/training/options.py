"""The methods' command-line options, generated from the fields of their configuration structs.

A field's type, bounds and ``Meta(description=...)`` define its option, so that a method registered
in ``TRAINABLE`` needs no further code here.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from inspect import Parameter
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import msgspec
import typer
from msgspec import Meta

from cvo_export.networks.heads import Method


@dataclass(frozen=True)
class _Field:
    """One option of one method."""

    method: str
    name: str
    kind: Any
    description: str
    bounds: str
    default: Any


def method_parameters(methods: Mapping[str, Method]) -> list[Parameter]:
    """Return a keyword parameter for each option of the methods; None by default.

    Methods that share an option share its parameter; its help names the methods and their defaults.
    Raises TypeError if methods use one name for options of different types.
    """
    options: dict[str, list[_Field]] = {}
    for method, registered in methods.items():
        for field in _fields(method, registered):
            options.setdefault(field.name, []).append(field)
    alone = [fields for fields in options.values() if len(fields) == 1]
    shared = [fields for fields in options.values() if len(fields) > 1]
    return [_parameter(fields, len(methods)) for fields in (*alone, *shared)]


def option_name(field: str) -> str:
    """Return the option name of a field: ``latent_size`` -> ``--latent-size``."""
    return "--" + field.replace("_", "-")


def _fields(method: str, registered: Method) -> Iterator[_Field]:
    for field in msgspec.structs.fields(registered.config):
        kind, metas = _unwrapped(field.type)
        description = next((meta.description for meta in metas if meta.description), "")
        bounds = ", ".join(bound for meta in metas if (bound := _bounds(meta)))
        yield _Field(method, field.name, kind, description, bounds, field.default)


def _unwrapped(kind: Any) -> tuple[Any, list[Meta]]:  # noqa: ANN401 - types of any kind
    """Strip ``Annotated`` and ``None`` from a type; also return its metadata."""
    if get_origin(kind) is Annotated:
        inner, *metas = get_args(kind)
        bare, more = _unwrapped(inner)
        return bare, [*(meta for meta in metas if isinstance(meta, Meta)), *more]
    if get_origin(kind) in (Union, UnionType):
        others = [part for part in get_args(kind) if part is not NoneType]
        if len(others) == 1:
            return _unwrapped(others[0])
    return kind, []


def _bounds(meta: Meta) -> str:
    limits = ((">=", meta.ge), (">", meta.gt), ("<=", meta.le), ("<", meta.lt))
    return ", ".join(f"{sign} {limit:g}" for sign, limit in limits if limit is not None)


def _parameter(fields: list[_Field], n_methods: int) -> Parameter:
    panel = f"Options of {fields[0].method}" if len(fields) == 1 else "Options of several methods"
    option = typer.Option(
        option_name(fields[0].name),
        help=_help(fields, n_methods),
        rich_help_panel=panel,
        show_default=False,
    )
    kind: Any = Annotated[_common_type(fields) | None, option]
    return Parameter(fields[0].name, Parameter.KEYWORD_ONLY, default=None, annotation=kind)


def _common_type(fields: list[_Field]) -> Any:  # noqa: ANN401 - types of any kind
    kinds = [field.kind for field in fields]
    if all(get_origin(kind) is Literal for kind in kinds):
        return Literal[tuple(dict.fromkeys(word for kind in kinds for word in get_args(kind)))]
    if any(kind != kinds[0] for kind in kinds):
        methods = ", ".join(field.method for field in fields)
        raise TypeError(
            f"{fields[0].name}: expected one type in the options of {methods}, found "
            f"{', '.join(str(kind) for kind in kinds)}"
        )
    return kinds[0]


def _help(fields: list[_Field], n_methods: int) -> str:
    """Return a sentence for each meaning, followed by the methods' defaults."""
    if len(fields) == 1:
        default = _shown(fields[0].default)
        notes = [fields[0].bounds, f"default: {default}" if default else ""]
        return _with_notes(fields[0].description, notes)
    meanings: dict[tuple[str, str], list[_Field]] = {}
    for field in fields:
        meanings.setdefault((field.description, field.bounds), []).append(field)
    return " ".join(
        _with_notes(description, [bounds, _defaults(alike, n_methods)])
        for (description, bounds), alike in meanings.items()
    )


def _defaults(fields: list[_Field], n_methods: int) -> str:
    methods: dict[str, list[str]] = {}
    for field in fields:
        methods.setdefault(_shown(field.default), []).append(field.method)
    if len(methods) == 1 and len(fields) == n_methods:
        return f"all methods: {next(iter(methods))}"
    return "; ".join(
        f"{', '.join(names)}: {default}" if default else ", ".join(names)
        for default, names in methods.items()
    )


def _with_notes(description: str, notes: list[str]) -> str:
    given = "; ".join(note for note in notes if note)
    return f"{description} ({given})".strip() if given else description


def _shown(value: object) -> str:
    if value is None:
        return ""
    if isinstance(value, tuple):
        return " ".join(_shown(part) for part in value)
    return f"{value:.3g}" if isinstance(value, float) else str(value)
