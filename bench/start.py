"""Start: load time, memory, and the time from a fresh process to its first interval.

    python bench/start.py

Every figure comes from fresh processes that take turns: onnxruntime with default settings on the
float32 model, with two threads and with one (a second thread spins); and ``Odometer.load`` with a
warm model cache in both precisions. Then whole processes: the smallest script of onnxruntime and
OpenCV that prints the pose of one JPEG file, and ``cvo-edge run`` on the same file; and the time
from the start of ``cvo-edge run`` on fifty files to its first record, by mode. Modules are compiled
beforehand, as an installation does.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from functools import partial
from typing import Any

import numpy as np
from networks import BACKBONES, PRECISIONS, WORK, frames, frames_as, whole_bundle
from rounds import Array, figures, in_turn, interleaved, ratio, write_report

METHOD, THREADS, ROUNDS, WARM_UP = "cjp", 2, 15, 2

# Both import their modules before the clock starts, and infer once before memory is read.
PLAIN = """
import json, sys
from time import perf_counter
import cv2, numpy, onnxruntime
options = onnxruntime.SessionOptions()
options.intra_op_num_threads = int(sys.argv[2])
begin = perf_counter()
session = onnxruntime.InferenceSession(sys.argv[1] + "/model.onnx", options)
load_ms = 1e3 * (perf_counter() - begin)
session.run(None, {"image": numpy.zeros((1, 224, 224, 3), numpy.uint8)})
anonymous = next(l for l in open("/proc/self/status") if l.startswith("RssAnon"))
print(json.dumps({"load_ms": load_ms, "anonymous_mib": int(anonymous.split()[1]) / 1024}))
"""
OURS = """
import os
os.environ["OPENBLAS_NUM_THREADS"] = "1"
import json, sys
from time import perf_counter
import cv2, numpy, onnxruntime
from cvo_edge import ModelCache, Odometer
begin = perf_counter()
odometer = Odometer.load(sys.argv[1], threads=2, cache=ModelCache.default())
load_ms = 1e3 * (perf_counter() - begin)
odometer.step(numpy.zeros((480, 640, 3), numpy.uint8))
anonymous = next(l for l in open("/proc/self/status") if l.startswith("RssAnon"))
print(json.dumps({"load_ms": load_ms, "anonymous_mib": int(anonymous.split()[1]) / 1024}))
"""
SCRIPT = """
import sys
import cv2, numpy, onnxruntime
session = onnxruntime.InferenceSession(sys.argv[1] + "/model.onnx")
image = cv2.cvtColor(cv2.resize(cv2.imread(sys.argv[2]), (224, 224)), cv2.COLOR_BGR2RGB)
print(session.run(None, {"image": image[numpy.newaxis]}))
"""
RUN = "from cvo_edge.__main__ import main; main()"


def loaded(backbone: str) -> dict[str, Any]:
    """Load time and anonymous memory of each, and their ratios to default onnxruntime."""
    plain, int8 = (str(whole_bundle(METHOD, backbone, p)) for p in ("fp32", "int8"))
    commands = {
        "onnxruntime": [PLAIN, plain, str(THREADS)],
        "onnxruntime, one thread": [PLAIN, plain, "1"],
        "cvo-edge fp32": [OURS, plain],
        "cvo-edge int8": [OURS, int8],
    }
    found: dict[str, list[dict[str, float]]] = {name: [] for name in commands}
    for number in range(WARM_UP + ROUNDS):
        for name, command in in_turn(list(commands.items()), number):
            found[name].append(json.loads(_run(command)))

    def values(name: str, key: str) -> Array:
        return np.array([row[key] for row in found[name][WARM_UP:]])

    return {
        name: {
            key: {
                **figures(values(name, key)),
                "over_onnxruntime": ratio(values(name, key), values("onnxruntime", key))["median"],
            }
            for key in ("load_ms", "anonymous_mib")
        }
        for name in commands
    }


def first_interval(backbone: str) -> dict[str, Any]:
    """Milliseconds of whole processes that end with the result of one file."""
    bundle, image = str(whole_bundle(METHOD, backbone)), str(frames()[0])
    calls = {
        "script": lambda _: _run([SCRIPT, bundle, image]),
        "cvo-edge": lambda _: _run([RUN, "run", bundle, image, "--quiet"]),
    }
    spent = interleaved(calls, rounds=ROUNDS, warmup=WARM_UP)
    return {
        "script_ms": figures(spent["script"]),
        "cvo_edge_ms": figures(spent["cvo-edge"]),
        "over_script": ratio(spent["cvo-edge"], spent["script"]),
    }


def first_record(backbone: str) -> dict[str, Any]:
    """Milliseconds from the start of ``run`` on a folder to its first record, by mode."""
    folder = str(frames_as("jpg"))
    found: dict[str, Any] = {}
    for precision in PRECISIONS:
        bundle = str(whole_bundle(METHOD, backbone, precision))
        calls = {
            mode: partial(_first_line, [RUN, "run", bundle, folder, "--quiet", "--mode", mode])
            for mode in ("latency", "throughput")
        }
        spent = interleaved(calls, rounds=ROUNDS, warmup=WARM_UP)
        found[precision] = {
            **{f"{mode}_ms": figures(ms) for mode, ms in spent.items()},
            "throughput_over_latency": ratio(spent["throughput"], spent["latency"]),
        }
    return found


def _first_line(arguments: list[str], _: int) -> None:
    command = [sys.executable, "-c", *arguments]
    with subprocess.Popen(command, stdout=subprocess.PIPE, env=_environment()) as process:
        # The header and the first record.
        if process.stdout is None or not (process.stdout.readline() and process.stdout.readline()):
            raise SystemExit("expected a record, found none")
        process.kill()


def _run(arguments: list[str]) -> str:
    command = [sys.executable, "-c", *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=_environment())
    return done.stdout


def _environment() -> dict[str, str]:
    environment = {**os.environ, "CVO_EDGE_CACHE": str(WORK / "cache")}
    # If it is set, every process compiles all modules of a checkout again.
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    return environment


def main() -> None:
    """Measure both backbones."""
    results: dict[str, Any] = {}
    for backbone in BACKBONES:
        results[backbone] = {
            "load": loaded(backbone),
            "process": first_interval(backbone),
            "first_record": first_record(backbone),
        }
        for name, row in results[backbone]["load"].items():
            load, memory = row["load_ms"], row["anonymous_mib"]
            print(
                f"{backbone:<16} {name:<23} load {load['median']:7.1f} ms "
                f"({load['over_onnxruntime']:.3f}), anonymous {memory['median']:6.1f} MiB "
                f"({memory['over_onnxruntime']:.3f})",
                flush=True,
            )
        process = results[backbone]["process"]
        print(
            f"{backbone:<16} first result: script {process['script_ms']['median']:.0f} ms, "
            f"cvo-edge {process['cvo_edge_ms']['median']:.0f} ms "
            f"({process['over_script']['median']:.3f})",
            flush=True,
        )
        for precision, row in results[backbone]["first_record"].items():
            print(
                f"{backbone:<16} first record of fifty, {precision}: latency "
                f"{row['latency_ms']['median']:.0f} ms, throughput "
                f"{row['throughput_ms']['median']:.0f} ms "
                f"({row['throughput_over_latency']['median']:.3f})",
                flush=True,
            )
    write_report("start", results, threads=THREADS, rounds=ROUNDS, warmup=WARM_UP, method=METHOD)


if __name__ == "__main__":
    main()
