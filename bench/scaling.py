"""How cost grows with input size, confidences, J of MCQR, trees of CQR and K of CSP.

    python bench/scaling.py

Briefly trained networks of the default kind (MobileNetV2 cut at stride 16, 256x192), one setting
changed at a time; ``uncertainty`` is array to interval less array to pose of the same network.
"""

from __future__ import annotations

from pathlib import Path
from time import perf_counter
from typing import Any
from unittest.mock import patch

import msgspec
import numpy as np
from frame import measured
from networks import ROOM, WORK, demonstration, images
from rounds import figures, write_report

from cvo_edge.bundle.format import CONFIDENCES as LEVELS
from cvo_edge.bundle.reading import encode_calibration, read_calibration
from cvo_edge.engine.loading import read_bundle
from cvo_edge.odometer import Odometer
from cvo_edge.sets import Scope
from cvo_export.networks.directional import Choice, RegionNetwork
from cvo_export.networks.heads import mcqr
from cvo_export.publish import publish
from cvo_export.training.configure import configure
from cvo_export.training.loop import train

ROUNDS = 99
SIZES = ("128x96", "256x192", "384x288", "512x384")
CONFIDENCES = (5, 10, 50)
# Method -> its option and the option's values.
OPTIONS: dict[str, tuple[str, tuple[int, ...]]] = {
    "mcqr": ("rays", (5, 21, 85, 192)),
    "cqr": ("trees", (10, 50, 100, 400)),
    "csp": ("classes", (16, 64, 128, 256)),
}


def bundle(method: str, size: str = "256x192", **head: int) -> Path:
    """Return a bundle with these options, made if it does not exist."""
    name = "-".join([method, size, *(f"{key}{value}" for key, value in head.items())])
    folder = WORK / "scaling" / name
    if not folder.exists():
        config = configure(
            method=method,
            dataset=ROOM,
            split="random",
            seed=0,
            size=size,
            crop="none",
            backbone="mobilenetv2_100",
            weights="none",
            stages="16",
            grid="3x4",
            normalisation=None,
            head=head,
            steps=100,
            copies=0,
        )
        features = WORK / "features"
        # Val would keep one ellipsoid here, but the cost of many is the question.
        with patch.object(mcqr, "thrifty_choice", whole_codebook):
            run = train(WORK / "runs" / name, config, lambda *_: None, features)
        publish(run, folder, name)
    return folder


def whole_codebook(network: RegionNetwork, *_: object) -> Choice:
    """Every point of the codebook, at its inflation as learned; arguments as ``thrifty_choice``."""
    return Choice(1.0, np.arange(len(network.shells)))


def one(folder: Path, scope: Scope = "marginal") -> dict[str, Any]:
    """Time one bundle as ``bench/frame.py`` does."""
    found: dict[str, Any] = measured(folder, ROUNDS, scope)
    outputs = {spec.name: list(spec.shape) for spec in read_calibration(folder).model.outputs}
    return {"outputs": outputs, **found}


def confidences(count: int) -> dict[str, Any]:
    """Time reading a bundle of this many confidences, and all their sets in both scopes."""
    source = demonstration("cjp")
    content = read_bundle(source)
    stored = list(content.calibration.thresholds)
    # In addition to the standard ones; a larger confidence never has a smaller threshold.
    for scope in ("marginal", "joint"):
        least = min((t for t in stored if t.scope == scope), key=lambda t: t.confidence)
        levels = np.linspace(0.51, 0.79, count - len(LEVELS)).round(4).tolist()
        stored += [msgspec.structs.replace(least, confidence=level) for level in levels]
    stored.sort(key=lambda t: (t.confidence, t.scope))
    calibration = msgspec.structs.replace(content.calibration, thresholds=tuple(stored))
    folder = WORK / "scaling" / f"confidences-{count}"
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "calibration.json").write_bytes(encode_calibration(calibration))
    read_ms, sets_ms = [], []
    odometer = Odometer(content)
    observation = odometer.observe(images()[0], 0)
    for _ in range(ROUNDS):
        begin = perf_counter()
        found = read_calibration(folder)
        read = perf_counter()
        for threshold in found.thresholds:
            odometer.conformal_set(observation, threshold)
        read_ms.append(1e3 * (read - begin))
        sets_ms.append(1e3 * (perf_counter() - read))
    return {
        "read_calibration_ms": figures(np.array(read_ms)),
        "sets_ms": figures(np.array(sets_ms)),
    }


def main() -> None:
    """Measure all of them."""
    results: dict[str, Any] = {"size": {}, "confidences": {}}
    for size in SIZES:
        results["size"][size] = one(bundle("cjp", size))
        show("size", size, results["size"][size])
    for count in CONFIDENCES:
        row = results["confidences"][str(count)] = confidences(count)
        print(f"confidences {count:>4}: {row}", flush=True)
    for method, (option, values) in OPTIONS.items():
        results[option] = {}
        for value in values:
            folder = bundle(method, **{option: value})
            row = results[option][str(value)] = one(folder)
            show(option, str(value), row)
            if method == "mcqr":
                row["joint"] = one(folder, "joint")
                show(option, f"{value}, joint", row["joint"])
    write_report("scaling", results, rounds=ROUNDS)


def show(what: str, value: str, row: dict[str, Any]) -> None:
    """Print one line."""
    cost = row["cost_of_uncertainty"]["median"]
    print(
        f"{what:<8} {value:>10}: raw {row['ms']['raw']['median']:.3f} ms, uncertainty "
        f"{row['uncertainty_ms']['median']:+.3f} ms ({cost:.3f}), of it "
        f"after the network {row['after_network_ms']['median']:.3f} ms",
        flush=True,
    )


if __name__ == "__main__":
    main()
