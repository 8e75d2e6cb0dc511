"""Evaluate the demonstration bundles on flights that they were neither trained nor calibrated on.

    python bench/demonstrations.py [BUNDLE ...]

Writes ``results/demonstrations/BUNDLE.json``; by default of all bundles in
``calibration_artifacts``. The figures are those of ``cvo-export evaluate BUNDLE
synthetic:room,flights=100``.
"""

from __future__ import annotations

import sys

from networks import ARTIFACTS, DEMONSTRATED, PRECISIONS, demonstration
from provenance import RESULTS, write_result

from cvo_export.datasets import open_dataset
from cvo_export.evaluate import evaluate, table

DATASET = "synthetic:room,flights=100"


def main() -> None:
    """Evaluate each bundle, print its table, write its figures."""
    bundles = [demonstration(method, p) for p in PRECISIONS for method in DEMONSTRATED]
    if sys.argv[1:]:
        bundles = [ARTIFACTS / name for name in sys.argv[1:]]
    dataset = open_dataset(DATASET)
    for bundle in bundles:
        report = evaluate(bundle, dataset, "test")
        print(*table(report), sep="\n", flush=True)
        write_result(RESULTS / "demonstrations" / f"{bundle.name}.json", report)


if __name__ == "__main__":
    main()
