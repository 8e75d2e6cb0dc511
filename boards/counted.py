"""Run a bundle on an emulated processor and mark, for ``instructions.c``, what is to be counted.

    python counted.py BUNDLE REPEATS

Counts are read before the first inference of the network, after the last, and after as many steps
of an odometer, from an array of 640x480 pixels to intervals.
"""

from __future__ import annotations

import os
import sys

import numpy as np

from cvo_edge.input import preprocess
from cvo_edge.odometer import Odometer

WARM_UP = 2


def mark() -> None:
    """Let the plugin print its counts."""
    os.getpriority(os.PRIO_PROCESS, 0)


def main() -> None:
    """Infer and step."""
    bundle, repeats = sys.argv[1], int(sys.argv[2])
    odometer = Odometer.load(bundle, threads=1)
    session = odometer.session
    if session is None:
        raise SystemExit("expected an open odometer, found a closed one")
    frame = preprocess.selftest_image(480, 640)
    feeds = {
        spec.name: preprocess.selftest_image(*spec.shape[1:3])[np.newaxis]
        if spec.dtype == "uint8"
        else np.ones(spec.shape, np.float32)
        for spec in session.inputs
    }
    for _ in range(WARM_UP):
        odometer.step(frame)
    mark()
    for _ in range(repeats):
        session.run(feeds)
    mark()
    for _ in range(repeats):
        odometer.step(frame)
    mark()


if __name__ == "__main__":
    main()
