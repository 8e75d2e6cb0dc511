"""Four cameras on two cores: by four services, and by one process with four odometers.

    python bench/four_cameras.py [--seconds 60]

Each way runs alone for the same time, with a load that leaves the cores time and with one that
does not: four ``cvo-edge serve`` processes; one process whose four threads each stream a camera
through an ``Odometer`` of its own. Every inference has one thread. The
cameras run in a process of their own, with pictures that are coded before. Each camera's account is
read back from its record file: frames delivered, records, frames dropped for newer ones, and what
is missing without being said. ``cores_used`` is processor time of the estimating processes per time
that passes; the rest of the two cores also serves the cameras.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import closing
from pathlib import Path
from threading import Event, Thread
from typing import Any

import numpy as np
from day import ACCOUNT, WRITTEN
from loopback_camera import LoopbackCamera
from networks import demonstration
from provenance import RESULTS, write_result

from cvo_edge.input.sources import open_source
from cvo_edge.odometer import Odometer
from cvo_edge.output.records import header_of, read_records
from cvo_edge.output.sinks import Sink

CAMERAS = 4
# Method, precision and frames per second of each camera: a load that two cores can carry, and one
# that they cannot.
LOADS = (("cjp", "int8", 30.0), ("scr", "fp32", 60.0))
# Processor time is measured from then on, when all have loaded.
WARM_S = 3.0


def serve_cameras(fps: float) -> None:
    """Print the addresses of four cameras; serve until the input ends."""
    cameras = [LoopbackCamera(fps) for _ in range(CAMERAS)]
    print(json.dumps([each.address for each in cameras]), flush=True)
    sys.stdin.read()


def four_processes(
    bundle: Path, addresses: list[str], folder: Path, seconds: float
) -> dict[str, Any]:
    """Run a service for each camera."""
    services = [
        subprocess.Popen(
            [
                *(sys.executable, "-m", "cvo_edge", "serve", str(bundle), address),
                *("-o", str(folder / f"{number}.jsonl"), "--threads", "1"),
            ],
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        for number, address in enumerate(addresses)
    ]
    time.sleep(WARM_S)
    begin, used_s = time.monotonic(), _used_s(services)
    time.sleep(seconds)
    used_s, passed_s = _used_s(services) - used_s, time.monotonic() - begin
    for service in services:
        service.send_signal(signal.SIGTERM)
    cameras = []
    for number, service in enumerate(services):
        text = service.communicate()[1]
        told, written = ACCOUNT.search(text), WRITTEN.search(text)
        if told is None or written is None:
            raise SystemExit(text)
        delivered, frames, dropped_frames = map(int, told.groups())
        path = folder / f"{number}.jsonl"
        cameras.append(_account(path, delivered, frames, dropped_frames, int(written[2])))
    return {"cameras": cameras, "cores_used": used_s / passed_s}


def one_process(bundle: Path, addresses: list[str], folder: Path, seconds: float) -> dict[str, Any]:
    """Run this program again with four odometers in threads."""
    command = [sys.executable, __file__, "--streams", str(folder), "--seconds", str(seconds)]
    command += ["--bundle", str(bundle), *addresses]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    found: dict[str, Any] = json.loads(done.stdout)
    accounts = [
        _account(folder / f"{number}.jsonl", *counts, 0)
        for number, counts in enumerate(found["counts"])
    ]
    return {"cameras": accounts, "cores_used": found["cores_used"]}


def streams(bundle: Path, addresses: list[str], folder: Path, seconds: float) -> dict[str, Any]:
    """Stream each camera through an odometer of its own, in threads of this process."""
    ended = Event()
    sources = [open_source(address, threads=1) for address in addresses]
    counts = [[0, 0, 0] for _ in addresses]

    def stream(number: int) -> None:
        source = sources[number]
        with (
            Odometer.load(bundle, threads=1, mode="live") as odometer,
            Sink(
                str(folder / f"{number}.jsonl"),
                "jsonl",
                header_of(odometer.calibration, odometer.chart, 0.9, "marginal"),
            ) as sink,
            closing(odometer.stream(source)) as estimates,
        ):
            next_seq = 0
            for estimate in estimates:
                sink.write(estimate)
                counts[number][1] += 1
                counts[number][2] += estimate.seq - next_seq
                next_seq = estimate.seq + 1
        counts[number][0] = source.delivered

    threads = [Thread(target=stream, args=(number,)) for number in range(len(addresses))]
    for thread in threads:
        thread.start()
    time.sleep(WARM_S)
    begin, used_s = time.monotonic(), time.process_time()
    ended.wait(seconds)
    cores_used = (time.process_time() - used_s) / (time.monotonic() - begin)
    for source in sources:
        source.stop()
    for thread in threads:
        thread.join()
    return {"counts": counts, "cores_used": cores_used}


def _account(
    path: Path, delivered: int, frames: int, dropped_frames: int, dropped_records: int
) -> dict[str, Any]:
    records = list(read_records(path))
    total_ms = [record.latency_ms["total"] for record in records]
    return {
        "delivered": delivered,
        "frames": frames,
        "dropped_frames": dropped_frames,
        "dropped_records": dropped_records,
        "records": len(records),
        "unsaid": delivered - dropped_frames - dropped_records - len(records),
        "p50_ms": round(float(np.percentile(total_ms, 50)), 2),
        "p99_ms": round(float(np.percentile(total_ms, 99)), 2),
    }


def _used_s(processes: list[subprocess.Popen[str]]) -> float:
    """Return the processor time that these processes have used."""
    ticks = 0
    for process in processes:
        fields = Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()
        ticks += int(fields[11]) + int(fields[12])
    return ticks / os.sysconf("SC_CLK_TCK")


def main() -> int:
    """Run each way and report -> 1 if a frame was lost unsaid."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("addresses", nargs="*", help=argparse.SUPPRESS)
    parser.add_argument("--seconds", type=float, default=45.0, help="length of each run")
    parser.add_argument("--streams", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--bundle", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--cameras", type=float, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.cameras:
        serve_cameras(given.cameras)
        return 0
    if given.streams:
        print(json.dumps(streams(given.bundle, given.addresses, given.streams, given.seconds)))
        return 0
    found = []
    for method, precision, fps in LOADS:
        command = [sys.executable, __file__, "--cameras", str(fps)]
        with subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        ) as cameras:
            assert cameras.stdout is not None
            addresses = json.loads(cameras.stdout.readline())
            load = {"method": method, "precision": precision, "fps": fps}
            for way, run in WAYS.items():
                with tempfile.TemporaryDirectory() as folder:
                    bundle = demonstration(method, precision)
                    done = run(bundle, addresses, Path(folder), given.seconds)
                found.append({"way": way, **load, **done})
                print(f"{way}, {load}: {done['cores_used']:.2f} cores used")
                print(*done["cameras"], sep="\n", flush=True)
            cameras.communicate()
    result = {"seconds": given.seconds, "runs": found}
    write_result(RESULTS / "service" / "four_cameras.json", result)
    return int(any(each["unsaid"] for run in found for each in run["cameras"]))


WAYS = {"four processes": four_processes, "one process, four odometers": one_process}


if __name__ == "__main__":
    sys.exit(main())
