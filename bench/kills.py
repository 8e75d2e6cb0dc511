"""Kill live runs that write MCAP, recover what they left, and count lost frames.

    python bench/kills.py [KILLS]

Each run is a process of its own: ``cvo-edge run -o live.mcap --mavlink ADDRESS`` over thousands of
images. A frame's messages are flushed into the file before its pose goes to the autopilot, so that
the poses that this program receives in the autopilot's place are frames that the run has confirmed.
At a random time, from the start of the process to well after its first pose, it gets SIGKILL. Then
``convert --recover`` finishes the file, rosbags reads it without tolerance, and every confirmed
frame has to be there, with the position that was sent. A frame that is in the file and was not
confirmed was killed between the two.

The count in the result file goes on where it ended, up to KILLS (default 1,000).

At the end, a file of a killed run and a finished one are cut at every byte of their last KiB.
"""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import tempfile
from itertools import cycle, islice
from pathlib import Path
from time import monotonic, sleep
from typing import Any

import numpy as np
from networks import ARTIFACTS
from provenance import RESULTS, read_result, result_files, write_result
from rosbags.highlevel import AnyReader

from cvo_edge.output.mcap import recover

FOLDER, NAME = "kills", "kills"
BUNDLE, CLIP = ARTIFACTS / "synthetic-room-cjp", ARTIFACTS / "synthetic-room-clip"
IMAGES, FPS = 4000, 10
# The clip's camera looks ahead; its world has z up.
PLACES = ("--map", "0,0,0,0.7071068,0.7071068,0,0", "--base", "0,0,0,0.5,0.5,0.5,-0.5")
# Most kills come so long after the first pose, others at any time before it.
RUNNING_S, STARTING_S, EARLY = 0.7, 0.8, 0.1
PATIENCE_S = 60.0
CUT = 1024
COUNTS = ("kills", "before_a_frame", "confirmed", "recovered", "lost", "others", "torn")


class Peer:
    """Receives poses in the place of an autopilot."""

    def __init__(self) -> None:
        from pymavlink import mavutil

        self._link: Any = mavutil.mavlink_connection("udpin:127.0.0.1:0")
        self.address = f"udpout:127.0.0.1:{self._link.port.getsockname()[1]}"

    def poses(self) -> dict[int, tuple[float, float, float]]:
        """Return position by stamp (us) of what has arrived since the last call."""
        found = {}
        while (got := self._link.recv_match(type="VISION_POSITION_ESTIMATE")) is not None:
            found[int(got.usec)] = (got.x, got.y, got.z)
        return found


def main() -> None:
    """Kill, recover, compare and write the result."""
    wanted = int(sys.argv[1]) if len(sys.argv) > 1 else 1000
    totals = dict.fromkeys(COUNTS, 0)
    if any(path.stem == NAME for path in result_files(FOLDER)):
        totals |= {key: read_result(FOLDER, NAME)[key] for key in COUNTS}
    generator, peer = random.Random(totals["kills"]), Peer()
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        images = folder / "images"
        images.mkdir()
        for number, path in enumerate(islice(cycle(sorted(CLIP.glob("*.color.jpg"))), IMAGES)):
            (images / f"{number:06d}.jpg").symlink_to(path)
        while totals["kills"] < wanted:
            found = one_kill(folder, images, peer, generator)
            totals = {key: totals[key] + found[key] for key in COUNTS}
            if totals["kills"] % 10 == 0 or totals["kills"] == wanted:
                print(totals, flush=True)
                ended = totals["kills"] == wanted
                result = {**totals, "cuts": cuts(folder) if ended else {}}
                write_result(RESULTS / FOLDER / f"{NAME}.json", result)


def one_kill(folder: Path, images: Path, peer: Peer, generator: random.Random) -> dict[str, int]:
    """Start a run, kill it, recover its file -> counts."""
    live, whole = folder / "live.mcap", folder / "whole.mcap"
    live.unlink(missing_ok=True)
    peer.poses()
    command = [sys.executable, "-m", "cvo_edge", "run", str(BUNDLE), str(images), "--quiet"]
    command += ["--fps", str(FPS), "-o", str(live), "--mavlink", peer.address, *PLACES]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    confirmed = {}
    if generator.random() < EARLY:
        sleep(generator.uniform(0.0, STARTING_S))
    else:
        began = monotonic()
        while not confirmed and process.poll() is None and monotonic() - began < PATIENCE_S:
            sleep(0.001)
            confirmed |= peer.poses()
        sleep(generator.uniform(0.0, RUNNING_S))
    process.send_signal(signal.SIGKILL)
    _, said = process.communicate()
    if process.returncode != -signal.SIGKILL:
        raise SystemExit(f"the run ended by itself: {said.decode()}")
    confirmed |= peer.poses()
    counts = {**dict.fromkeys(COUNTS, 0), "kills": 1, "confirmed": len(confirmed)}
    if not live.exists():
        return {**counts, "before_a_frame": 1, "lost": len(confirmed)}
    # The program's own command; a file without any record is no MCAP file.
    done = subprocess.run(
        [sys.executable, "-m", "cvo_edge", "convert", "--recover", str(live), "-o", str(whole)],
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        return {**counts, "before_a_frame": 1, "lost": len(confirmed)}
    read = positions(whole)
    kept = [
        stamp
        for stamp, position in confirmed.items()
        if stamp in read and np.array_equal(np.float32(read[stamp]), np.float32(position))
    ]
    return {
        **counts,
        "before_a_frame": int(not read),
        "recovered": len(kept),
        "lost": len(confirmed) - len(kept),
        "others": len(read) - len(kept),
        "torn": int(is_torn(live)),
    }


def positions(path: Path) -> dict[int, list[float]]:
    """Return position by stamp (us) of all poses of a file, as a strict reader has them."""
    with AnyReader([path]) as reader:
        return {
            stamp_ns // 1000: [getattr(message.pose.pose.position, axis) for axis in "xyz"]
            for connection, stamp_ns, raw in reader.messages()
            if connection.topic == "/cvo/pose"
            for message in (reader.deserialize(raw, connection.msgtype),)
        }


def is_torn(path: Path) -> bool:
    """Return whether a file ends within a record."""
    content, end = path.read_bytes(), 8
    while end + 9 <= len(content):
        end += 9 + int.from_bytes(content[end + 1 : end + 9], "little")
    return end != len(content)


def cuts(folder: Path) -> dict[str, list[int]]:
    """Cut files at every byte of their end -> cuts, and cuts from which too little came back."""
    live, whole = folder / "live.mcap", folder / "whole.mcap"
    torn, again = folder / "torn.mcap", str(folder / "again.mcap")
    found = {}
    for name, path in (("killed", live), ("finished", whole)):
        if not path.exists():
            continue
        content = path.read_bytes()
        kinds, ends = records_of(content)
        bad = 0
        lengths = range(max(8, len(content) - CUT), len(content) + 1)
        for length in lengths:
            torn.write_bytes(content[:length])
            messages = sum(
                kind == 5 and end <= length for kind, end in zip(kinds, ends, strict=True)
            )
            got = recover(torn, again)
            with AnyReader([Path(again)]) as reader:
                bad += got.messages != messages or sum(1 for _ in reader.messages()) != messages
        found[name] = [len(lengths), bad]
    return found


def records_of(content: bytes) -> tuple[list[int], list[int]]:
    """Return kinds and ends of the records that begin within a file."""
    kinds, ends, begin = [], [], 8
    while begin + 9 <= len(content) - 8:
        kinds.append(content[begin])
        begin += 9 + int.from_bytes(content[begin + 1 : begin + 9], "little")
        ends.append(begin)
    return kinds, ends


if __name__ == "__main__":
    os.environ["OMP_NUM_THREADS"] = "1"
    main()
