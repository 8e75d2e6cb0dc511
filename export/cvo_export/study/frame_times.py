"""Time per frame, from array to interval, of interleaved bundles."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from time import perf_counter
from typing import Any

from msgspec import Struct

from cvo_edge.engine.cores import allowed_cores
from cvo_edge.odometer import Odometer
from cvo_edge.programs.measure import environment, quantiles
from cvo_export.datasets import PoseDataset
from cvo_export.evaluate import subset_indices
from cvo_export.files import read_json, write_json

_WARM_UP_ROUNDS, _ROUNDS = 15, 200
# Number of distinct frames in a timing pass, kept in memory.
_TIMED_FRAMES = 20


class Timing(Struct, frozen=True, forbid_unknown_fields=True):
    """Milliseconds from array to interval; digests of the bundles, and the machine."""

    bundles: dict[str, str]
    threads: int
    environment: dict[str, Any]
    ms: dict[str, dict[str, float]]


def timed(path: Path, bundles: Mapping[str, tuple[str, Path]], dataset: PoseDataset) -> Timing:
    """Return milliseconds per frame of bundles (digest, folder) by name.

    Uses the results at ``path`` if they belong to these bundles; otherwise measures on test frames
    and writes them there.
    """
    digests = {name: digest for name, (digest, _) in bundles.items()}
    if path.is_file():
        stored = read_json(path, Timing, "timings")
        if digests.items() <= stored.bundles.items():
            return stored
    threads = allowed_cores()
    folders = {name: folder for name, (_, folder) in bundles.items()}
    timing = Timing(digests, threads, environment(threads), frame_ms(folders, dataset))
    write_json(path, timing)
    return timing


def frame_ms(bundles: Mapping[str, Path], dataset: PoseDataset) -> dict[str, dict[str, float]]:
    """Time bundles alternately, one frame each, so that changes of clock speed affect all."""
    with ExitStack() as stack:
        odometers = {
            name: stack.enter_context(Odometer.load(folder)) for name, folder in bundles.items()
        }
        names = list(odometers)
        indices = subset_indices(odometers[names[0]].calibration, dataset, "test")
        images = [dataset.read_image(index) for index in indices[:_TIMED_FRAMES].tolist()]
        spent: dict[str, list[float]] = {name: [] for name in names}
        for number in range(_WARM_UP_ROUNDS + _ROUNDS):
            image = images[number % len(images)]
            # Each bundle comes first, and follows each other bundle, equally often.
            shift = number % len(names)
            for name in names[shift:] + names[:shift]:
                begin = perf_counter()
                odometers[name].step(image)
                end = perf_counter()
                if number >= _WARM_UP_ROUNDS:
                    spent[name].append(1e3 * (end - begin))
    return {name: quantiles(values) for name, values in spent.items()}
