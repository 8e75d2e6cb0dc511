"""Run an int8 bundle with and without ``session.x64quantprecision`` on this processor.

    python boards/saturation.py BUNDLE FOLDER COUNT

This is a control: on x86 without VNNI, the poses without the option must be wrong; otherwise the
comparison did not test such a processor. Prints JSON, ``{"with": [poses], "without": [poses]}``.
"""

from __future__ import annotations

import json
import sys
from itertools import islice
from pathlib import Path

import onnxruntime

from cvo_edge.engine.loading import read_bundle
from cvo_edge.input import preprocess
from cvo_edge.input.sources import open_source


def poses(bundle_dir: Path, folder: str, count: int, *, precise: bool) -> list[list[float]]:
    """Return the model's output ``pose`` (7 numbers) for the first ``count`` images of a folder."""
    bundle = read_bundle(bundle_dir)
    spec = bundle.calibration.preprocess
    extra = bundle.head.extra_inputs(0)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    options.add_session_config_entry("session.x64quantprecision", str(int(precise)))
    session = onnxruntime.InferenceSession(
        bundle.model_bytes, options, providers=["CPUExecutionProvider"]
    )
    found = []
    for frame in islice(open_source(folder), count):
        image = preprocess.to_bgr8(frame.image)
        assert image is not None, frame.source
        tensor = preprocess.model_input(image, spec.height, spec.width, spec.crop)
        found.append(session.run(["pose"], {"image": tensor, **extra})[0][0].tolist())
    return found


if __name__ == "__main__":
    bundle_dir, folder, count = Path(sys.argv[1]), sys.argv[2], int(sys.argv[3])
    print(
        json.dumps(
            {
                "with": poses(bundle_dir, folder, count, precise=True),
                "without": poses(bundle_dir, folder, count, precise=False),
            }
        )
    )
