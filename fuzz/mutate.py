"""Random mutations of bytes and JSON documents."""

from __future__ import annotations

import copy
import hashlib
import json
import math
from collections.abc import Callable
from typing import Any

import numpy as np

Generator = np.random.Generator


def changed_bytes(content: bytes, generator: Generator) -> bytes:
    """Return different bytes, after one to four random changes."""
    changed = content
    while changed == content:
        for _ in range(int(generator.integers(1, 5))):
            kind = _BYTE_CHANGES[int(generator.integers(len(_BYTE_CHANGES)))]
            changed = kind(changed, generator) or b"\0"
    return changed


def _flip(content: bytes, generator: Generator) -> bytes:
    place = int(generator.integers(len(content)))
    return (
        content[:place]
        + bytes([content[place] ^ 1 << int(generator.integers(8))])
        + content[place + 1 :]
    )


def _overwrite(content: bytes, generator: Generator) -> bytes:
    place, length = _span(content, generator)
    return content[:place] + generator.bytes(length) + content[place + length :]


def _zero(content: bytes, generator: Generator) -> bytes:
    place, length = _span(content, generator)
    return content[:place] + bytes(length) + content[place + length :]


def _delete(content: bytes, generator: Generator) -> bytes:
    place, length = _span(content, generator)
    return content[:place] + content[place + length :]


def _repeat(content: bytes, generator: Generator) -> bytes:
    place, length = _span(content, generator)
    return content[: place + length] + content[place:]


def _insert(content: bytes, generator: Generator) -> bytes:
    place, length = _span(content, generator)
    return content[:place] + generator.bytes(length) + content[place:]


def _cut(content: bytes, generator: Generator) -> bytes:
    return content[: int(generator.integers(len(content)))]


def _exchange(content: bytes, generator: Generator) -> bytes:
    place, length = _span(content, generator)
    other = int(generator.integers(max(1, len(content) - length)))
    return content[:place] + content[other : other + length] + content[place + length :]


def _span(content: bytes, generator: Generator) -> tuple[int, int]:
    """Return a random start and a length that is usually small."""
    longest = max(1, min(len(content) // 2, 4096))
    length = int(math.exp(generator.uniform(0.0, math.log(longest + 1))))
    return int(generator.integers(max(1, len(content) - length + 1))), max(1, length)


_BYTE_CHANGES: tuple[Callable[[bytes, Generator], bytes], ...] = (
    _flip,
    _flip,
    _overwrite,
    _zero,
    _delete,
    _repeat,
    _insert,
    _cut,
    _exchange,
)

# Replacements for any value of a document.
_VALUES: tuple[object, ...] = (
    *(None, True, False, 0, 1, -1, 2**31, 2**63, -(2**63), 10**19),
    *(0.0, -0.0, 0.5, -1.5, 1e-300, 1e300, -1e300, 1e38),
    *("", "x", "\x1b[31m", "../../etc/passwd", "\ud800", "1", "NaN", "ok" * 150),
    *([], [0], [[]], [None] * 6, [1e9] * 6, {}, {"a": 1}),
)
# Replacements for a digit in the text; most are not valid JSON numbers.
_WORDS = ("NaN", "Infinity", "-Infinity", "1e999", "-1e999", "0x10", "1_000", "01", "9" * 5000)


def changed_document(document: dict[str, Any], generator: Generator) -> bytes:
    """Return a document as JSON, after one to three changes of values, keys or elements."""
    changed = copy.deepcopy(document)
    for _ in range(int(generator.integers(1, 4))):
        places = list(_places(changed))
        parent, key = places[int(generator.integers(len(places)))]
        kind = int(generator.integers(6))
        if kind == 0:
            del parent[key]
        elif kind == 1 and isinstance(parent, dict):
            parent[f"{key}_"] = parent.pop(key)
        elif kind == 2 and isinstance(parent, list):
            parent.insert(int(generator.integers(len(parent) + 1)), copy.deepcopy(parent[key]))
        elif kind == 3 and isinstance(parent[key], (int, float)):
            scale = float(np.exp(generator.normal(0.0, 3.0)))
            parent[key] = parent[key] * scale * float(generator.choice([-1.0, 1.0]))
        else:
            parent[key] = copy.deepcopy(_VALUES[int(generator.integers(len(_VALUES)))])
    text = json.dumps(changed)
    if generator.random() < 0.1:
        digits = [place for place, letter in enumerate(text) if letter.isdigit()]
        place = digits[int(generator.integers(len(digits)))]
        word = _WORDS[int(generator.integers(len(_WORDS)))]
        text = text[:place] + word + text[place + 1 :]
    return text.encode("utf-8", "surrogatepass")


def _places(node: Any) -> Any:  # noqa: ANN401 - any JSON value
    """Yield every (parent, key) of a document."""
    pairs = node.items() if isinstance(node, dict) else enumerate(node)
    for key, value in list(pairs):
        yield node, key
        if isinstance(value, (dict, list)):
            yield from _places(value)


def with_digest(content: bytes) -> bytes:
    """Return ``calibration.json`` with its digest recomputed, if it still has a digest key."""
    start = content.find(b'"digest": "')
    if start < 0:
        return content
    start += len(b'"digest": "')
    blank = content[:start] + b"0" * 64 + content[start + 64 :]
    return blank[:start] + hashlib.sha256(blank).hexdigest().encode() + blank[start + 64 :]
