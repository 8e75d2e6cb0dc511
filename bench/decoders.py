"""Decoders of JPEG files beside the one in use, whole and at half size: time and equal pixels.

    python bench/decoders.py [FOLDER NAME] [--rounds 600]

The first fifty JPEG files of 640x480 in a folder, by default those of ``python bench/networks.py``;
one thread, one call of each decoder in turn. Writes ``results/decoders/NAME.json``. A decoder that
is not installed is left out: ``pip install -e ".[peers]"``.
"""

from __future__ import annotations

import argparse
import io
from collections.abc import Callable
from functools import partial
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from networks import WORK
from numpy.typing import NDArray
from provenance import RESULTS, write_result
from rounds import figures, interleaved, ratio

from cvo_edge.input.decoding import decode_image, image_size
from cvo_edge.input.preprocess import halved, model_input

Image = NDArray[np.uint8]
Decoder = Callable[[bytes], Image]

FILES, INPUT = 50, (192, 256)
WHOLE, HALF = "cvo-edge", "cvo-edge, half"
COLOUR = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION


def simplejpeg(half: bool) -> Decoder:
    """TurboJPEG through Cython, into BGR."""
    decode = import_module("simplejpeg").decode_jpeg
    limits = {"min_height": 240, "min_width": 320, "min_factor": 2} if half else {}
    return lambda content: decode(content, "BGR", **limits)


def pillow(half: bool) -> Decoder:
    """Pillow, into RGB; ``draft`` decodes at half size."""
    pictures = import_module("PIL.Image")

    def decode(content: bytes) -> Image:
        picture = pictures.open(io.BytesIO(content))
        if half:
            picture.draft("RGB", (320, 240))
        return np.asarray(picture)

    return decode


def imagecodecs(_: bool) -> Decoder:
    """libjpeg-turbo through Cython, into RGB; whole only."""
    return import_module("imagecodecs").jpeg8_decode


def torchvision(_: bool) -> Decoder:
    """Into planes of RGB, whole only."""
    torch, codec = import_module("torch"), import_module("torchvision.io")
    torch.set_num_threads(1)

    def decode(content: bytes) -> Image:
        planes = codec.decode_jpeg(torch.frombuffer(bytearray(content), dtype=torch.uint8))
        return planes.permute(1, 2, 0).numpy()

    return decode


PEERS = {
    "simplejpeg": (simplejpeg, (False, True)),
    "pillow": (pillow, (False, True)),
    "imagecodecs": (imagecodecs, (False,)),
    "torchvision": (torchvision, (False,)),
}


def decoders() -> tuple[dict[str, Decoder], dict[str, str]]:
    """Return the decoders that are installed, by name, and the releases of their packages."""
    found: dict[str, Decoder] = {
        WHOLE: decode_image,
        HALF: partial(decode_image, decode="half"),
        "without checks": lambda c: cv2.imdecode(np.frombuffer(c, np.uint8), COLOUR),
    }
    releases = {"opencv": cv2.__version__}
    for name, (made, halves) in PEERS.items():
        for half in halves:
            try:
                found[f"{name}, half" if half else name] = made(half)
            except ImportError:
                print(f"{name} is not installed: left out")
                break
            releases[name] = version(name)
    return found, releases


def to_input(decode: Decoder, contents: list[bytes], number: int) -> Image:
    """File to the model's input."""
    return model_input(decode(contents[number % len(contents)]), *INPUT, "none")


def equal_pixels(decode: Decoder, like: Decoder, contents: list[bytes]) -> int:
    """Count the files that come out the same, in this or the other order of colours."""
    pairs = ((decode(content), like(content)) for content in contents)
    return sum(np.array_equal(a, b) or np.array_equal(a[..., ::-1], b) for a, b in pairs)


def differences(contents: list[bytes]) -> dict[str, float]:
    """Grey levels between half pictures and the rounded means of four pixels of whole ones."""
    found = []
    for content in contents:
        whole, half = decode_image(content), decode_image(content, decode="half")
        if whole is None or half is None:
            raise SystemExit("a file does not decode")
        found.append(np.abs(halved(whole, *half.shape[:2]).astype(int) - half))
    values = np.array(found)
    low, high = np.percentile(values, (50, 99)).tolist()
    return {"mean": round(values.mean(), 3), "median": low, "p99": high, "max": float(values.max())}


def main() -> None:
    """Compare, time and write the result."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, nargs="?", default=WORK / "flights")
    parser.add_argument("name", nargs="?", default="times")
    parser.add_argument("--rounds", type=int, default=600)
    arguments = parser.parse_args()
    rounds = arguments.rounds
    cv2.setNumThreads(1)
    contents = [path.read_bytes() for path in sorted(arguments.folder.glob("*.jpg"))[:FILES]]
    found, releases = decoders()
    results: dict[str, Any] = {}
    calls: dict[str, Callable[[int], object]] = {
        name: (lambda number, decode=decode: decode(contents[number % len(contents)]))
        for name, decode in found.items()
    }
    for name in (WHOLE, HALF):
        calls[f"{name}, input"] = partial(to_input, found[name], contents)
    calls["header"] = lambda number: image_size(contents[number % len(contents)])
    spent = interleaved(calls, rounds=rounds, warmup=20)
    for name, decode in found.items():
        like = found[HALF if name.endswith("half") else WHOLE]
        results[name] = {
            "ms": figures(spent[name]),
            "over_whole": ratio(spent[name], spent[WHOLE]),
            "equal_files": equal_pixels(decode, like, contents),
        }
    write_result(
        RESULTS / "decoders" / f"{arguments.name}.json",
        {
            "settings": {"rounds": rounds, "files": len(contents), "releases": releases},
            "header_ms": figures(spent["header"]),
            "to_input_ms": {name: figures(spent[f"{name}, input"]) for name in (WHOLE, HALF)},
            "to_input_half_over_whole": ratio(spent[f"{HALF}, input"], spent[f"{WHOLE}, input"]),
            "half_less_mean_of_four": differences(contents),
            "results": results,
        },
    )


if __name__ == "__main__":
    main()
