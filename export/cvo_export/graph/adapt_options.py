"""The options ``--input``, ``--output`` and ``--size``, which say what a network's tensors are."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from typing import Any

from cvo_edge.errors import UsageError

ROLES = ("pose", "translation", "rotation", "lower", "upper")
_CHOICES = {
    "layout": ("nchw", "nhwc"),
    "range": ("0-1", "0-255"),
    "order": ("rgb", "bgr"),
    "form": (
        *("quaternion_xyzw", "quaternion_wxyz", "matrix", "rotvec", "logq", "six", "six_rows"),
    ),
    "unit": ("m", "cm", "mm"),
    "direction": ("camera_to_world", "world_to_camera"),
    "axes": ("opencv", "opengl"),
}
_INPUT = ("name", "layout", "range", "order", "mean", "std")
_OF_ROLE = {
    "pose": ("form", "unit", "direction", "axes"),
    "translation": ("unit",),
    "rotation": ("form", "direction", "axes"),
    "lower": (),
    "upper": (),
}


@dataclass(frozen=True)
class InputForm:
    """What a network takes: (image * range - mean) / std, per channel in the network's order."""

    name: str | None = None
    layout: str | None = None
    range: str | None = None
    order: str = "rgb"
    mean: tuple[float, ...] | None = None
    std: tuple[float, ...] | None = None


@dataclass(frozen=True)
class OutputForm:
    """What one output of a network means."""

    name: str
    form: str = "quaternion_xyzw"
    unit: str = "m"
    direction: str = "camera_to_world"
    axes: str = "opencv"


def read_input(text: str | None) -> InputForm:
    """Read ``name=x,layout=nchw,range=0-1,mean=.5/.5/.5,std=.5/.5/.5,order=bgr``."""
    found: dict[str, Any] = _pairs("--input", text or "", _INPUT)
    for key in ("mean", "std"):
        if key in found:
            found[key] = _numbers(key, found[key])
    return InputForm(**found)


def read_outputs(texts: Sequence[str]) -> dict[str, OutputForm]:
    """Read texts such as ``rotation=q,form=quaternion_wxyz``."""
    outputs: dict[str, OutputForm] = {}
    for text in texts:
        first, _, rest = text.partition(",")
        role, equals, name = first.partition("=")
        if role not in ROLES or not equals or not name or role in outputs:
            raise UsageError(
                f"--output: expected one {', '.join(ROLES)} each, as pose=NAME, found {text}"
            )
        outputs[role] = OutputForm(name, **_pairs("--output", rest, _OF_ROLE[role]))
    return outputs


def input_text(form: InputForm) -> str:
    """Return the text that ``read_input`` reads as this form."""
    return ",".join(_stated(form, _INPUT))


def output_text(role: str, form: OutputForm) -> str:
    """Return the text that ``read_outputs`` reads as this form."""
    return ",".join([f"{role}={form.name}", *_stated(form, _OF_ROLE[role])])


def read_size(text: str | None) -> tuple[int, int] | None:
    """Read ``224x320``, height and width."""
    if text is None:
        return None
    height, _, width = text.partition("x")
    if not (height.isdecimal() and width.isdecimal() and int(height) and int(width)):
        raise UsageError(f"--size: expected HEIGHTxWIDTH such as 224x320, found {text}")
    return int(height), int(width)


def _stated(form: InputForm | OutputForm, keys: Sequence[str]) -> Iterator[str]:
    """Yield ``key=value`` for what differs from its default."""
    defaults = {each.name: each.default for each in fields(form)}
    for key in keys:
        value = getattr(form, key)
        if value != defaults[key]:
            text = "/".join(f"{n:g}" for n in value) if isinstance(value, tuple) else value
            yield f"{key}={text}"


def _pairs(option: str, text: str, known: Sequence[str]) -> dict[str, str]:
    found: dict[str, str] = {}
    for part in filter(None, text.split(",")):
        key, equals, value = part.partition("=")
        if key not in known or not equals or key in found:
            raise UsageError(
                f"{option}: expected {', '.join(known) or 'nothing'} once each, found {part}"
            )
        if value not in _CHOICES.get(key, (value,)):
            raise UsageError(
                f"{option}: expected {key}= one of {', '.join(_CHOICES[key])}, found {value}"
            )
        found[key] = value
    return found


def _numbers(key: str, text: str) -> tuple[float, ...]:
    try:
        numbers = tuple(float(part) for part in text.split("/"))
    except ValueError:
        numbers = ()
    if not all(map(math.isfinite, numbers)):
        numbers = ()
    if len(numbers) not in (1, 3) or (key == "std" and not all(n > 0 for n in numbers)):
        raise UsageError(
            f"--input: expected {key}= one number or three as .5/.5/.5"
            f"{', positive' if key == 'std' else ''}, found {text}"
        )
    return numbers
