"""A day of a service in minutes: what it loses, and what it says of it.

    python bench/day.py [--seconds 240] [--fps 15]    # as root, with libfaketime (apt-get)

Runs real ``cvo-edge serve`` processes as systemd would: it starts them again after each end,
listens to their notifications and keeps a watchdog. A camera on loopback is switched off, hangs and
flaps; the disk, a small tmpfs, fills up and is freed; the clock of the process (libfaketime) is set
forward and back; the process is stopped and continued; its file is rotated by rename and by
truncation; it is ended and started again. At the end every record file is read back. A loss is
*unsaid* if a frame that the camera delivered has no record and is not among those that the service
says it dropped.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from threading import Thread
from typing import Any

from loopback_camera import LoopbackCamera
from networks import ARTIFACTS
from provenance import RESULTS, write_result

from cvo_edge.output.records import read_records

WATCHDOG_S, TIMEOUT_S, DISK_MIB = 10.0, 2.0, 24
HOURS = 24
FAKETIME = "faketime/libfaketimeMT.so.1"
ACCOUNT = re.compile(r"(\d+) frames delivered = (\d+) estimated \+ (\d+) dropped for newer ones")
WRITTEN = re.compile(r"records +(\d+) written, (\d+) dropped")


@dataclass
class Life:
    """One process from its start to its end."""

    process: subprocess.Popen[str]
    lines: list[str] = field(default_factory=list)
    asked_to_end: bool = False
    reading: Thread | None = None


class Unit:
    """Starts the service and listens to it, as systemd does."""

    def __init__(self, folder: Path, disk: Path, address: str) -> None:
        self.output, self.clock = disk / "records.jsonl", folder / "clock"
        self.clock.write_text("+0")
        self._address, self._folder = address, folder
        self.notices: Counter[str] = Counter()
        self.longest_s, self._fed_s = 0.0, None
        self.lives: list[Life] = []
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(str(folder / "notify"))
        Thread(target=self._listen, daemon=True).start()

    def _listen(self) -> None:
        while True:
            for line in self._socket.recv(65536).decode().splitlines():
                key = line.partition("=")[0]
                self.notices[key] += 1
                if key in ("READY", "WATCHDOG"):
                    now, before = time.monotonic(), self._fed_s
                    if before is not None:
                        self.longest_s = max(self.longest_s, now - before)
                    self._fed_s = now

    def start(self) -> None:
        """Start a process."""
        library = next(Path("/usr/lib").glob(f"*/{FAKETIME}"))
        environment = {
            **os.environ,
            "NOTIFY_SOCKET": str(self._folder / "notify"),
            "WATCHDOG_USEC": str(round(1e6 * WATCHDOG_S)),
            "LD_PRELOAD": str(library),
            "FAKETIME_TIMESTAMP_FILE": str(self.clock),
            "FAKETIME_DONT_FAKE_MONOTONIC": "1",
            "FAKETIME_CACHE_DURATION": "1",
        }
        command = [
            *(sys.executable, "-m", "cvo_edge", "serve", str(ARTIFACTS / "synthetic-room-cjp")),
            *(self._address, "-o", str(self.output), "--threads", "1"),
            *("--timeout", str(TIMEOUT_S), "--health-every", "10"),
        ]
        process = subprocess.Popen(
            command, env=environment, stderr=subprocess.PIPE, text=True, start_new_session=True
        )
        life = Life(process)
        life.reading = Thread(target=self._read, args=(life,), daemon=True)
        life.reading.start()
        self.lives.append(life)

    def _read(self, life: Life) -> None:
        assert life.process.stderr is not None
        life.lines.extend(line.rstrip("\n") for line in life.process.stderr)

    def tell(self, number: int) -> None:
        """Send a signal to the running process."""
        self.lives[-1].process.send_signal(number)

    def end(self) -> int:
        """End the process as systemd does -> its exit code."""
        life = self.lives[-1]
        life.asked_to_end, self._fed_s = True, None
        life.process.terminate()
        code = life.process.wait(10.0)
        assert life.reading is not None
        life.reading.join(10.0)
        return code

    def pause(self, seconds: float) -> None:
        """Stop the process for a while; systemd's watchdog is not kept meanwhile."""
        self.tell(signal.SIGSTOP)
        time.sleep(seconds)
        self._fed_s = None
        self.tell(signal.SIGCONT)


class Day:
    """The events of a day, each at its hour."""

    def __init__(self, unit: Unit, camera: LoopbackCamera, disk: Path, hour_s: float) -> None:
        self.unit, self.camera, self.disk, self.hour_s = unit, camera, disk, hour_s
        self.codes: list[int] = []
        self.first_connection: int | None = None
        self._rotations = 0

    def events(self) -> list[tuple[float, str, Callable[[], None]]]:
        """Return hour, name and what is done."""
        unit = self.unit
        return [
            (0.0, "start without a camera", unit.start),
            (1.0, "camera comes", lambda: self.switch("on")),
            (2.5, "stopped for half an hour", lambda: unit.pause(0.5 * self.hour_s)),
            (4.5, "camera lost", lambda: self.switch("off")),
            (5.5, "camera back", lambda: self.switch("on")),
            (6.5, "rotated by rename and SIGHUP", self.rename),
            (7.5, "disk full", lambda: self.fill(True)),
            (8.7, "disk free", lambda: self.fill(False)),
            (9.5, "clock set forward", lambda: unit.clock.write_text("+7200")),
            (10.5, "clock set back", lambda: unit.clock.write_text("-3600")),
            (11.5, "camera hangs", lambda: self.switch("hangs")),
            (12.5, "camera no longer hangs", lambda: self.switch("on")),
            (13.3, "SIGTERM, started again", self.restart),
            (14.5, "rotated by copy and truncation", self.copy_and_truncate),
            (15.5, "disk full", lambda: self.fill(True)),
            (15.9, "SIGTERM, started again on the full disk", self.restart),
            (16.7, "camera lost while the disk is full", lambda: self.switch("off")),
            (17.3, "camera back", lambda: self.switch("on")),
            (17.7, "disk free", lambda: self.fill(False)),
            (18.7, "camera flaps", self.flap),
            (20.5, "rotated by rename and SIGHUP", self.rename),
            (21.0, "stopped for a quarter of an hour", lambda: unit.pause(0.25 * self.hour_s)),
            (22.5, "camera lost", lambda: self.switch("off")),
            (23.2, "camera back", lambda: self.switch("on")),
            (HOURS, "SIGTERM", lambda: self.codes.append(unit.end())),
        ]

    def switch(self, state: str) -> None:
        """Set the camera's state."""
        if state == "off" and self.first_connection is None:
            self.first_connection = len(self.camera.sent)
        self.camera.state = state

    def fill(self, full: bool) -> None:
        """Fill the disk to its last byte, or free it."""
        filler = self.disk / "filler"
        if not full:
            filler.unlink()
            return
        with filler.open("wb", buffering=0) as stream:
            try:
                while True:
                    stream.write(bytes(1 << 12))
            except OSError:
                return

    def rename(self) -> None:
        """Rotate as logrotate does."""
        self._rotations += 1
        self.unit.output.rename(f"{self.unit.output}.{self._rotations}")
        self.unit.tell(signal.SIGHUP)

    def copy_and_truncate(self) -> None:
        """Rotate as logrotate does with copytruncate; a record in between would be lost."""
        self._rotations += 1
        shutil.copyfile(self.unit.output, f"{self.unit.output}.{self._rotations}")
        os.truncate(self.unit.output, 0)

    def restart(self) -> None:
        """End the service and start it again."""
        self.codes.append(self.unit.end())
        self.unit.start()

    def flap(self) -> None:
        """Lose the camera again and again."""
        for state in ("off", "on") * 4:
            self.switch(state)
            time.sleep(0.15 * self.hour_s)

    def play(self) -> list[dict[str, Any]]:
        """Let the day pass -> what happened, with the lines that the service said of it."""
        begin, happened = time.monotonic(), []
        for hour, name, act in self.events():
            time.sleep(max(0.0, begin + hour * self.hour_s - time.monotonic()))
            seen = len(self.said())
            act()
            happened.append({"hour": hour, "event": name, "seen": seen})
            print(f"{hour:5.1f} h  {name}", flush=True)
            if self.unit.lives[-1].process.poll() is not None and hour < HOURS:
                print(*self.unit.lives[-1].lines, sep="\n")
                raise SystemExit("the service has ended by itself")
        said = self.said()
        for event, after in zip(happened, [*happened[1:], {"seen": len(said)}], strict=True):
            event["said"] = said[event.pop("seen") : after["seen"]]
        return happened

    def said(self) -> list[str]:
        """Return what the service has said but for health lines and summaries."""
        words = ("camera ", "records are", "clock ", "stood", "stuck", "No space", "renamed")
        lines = [line for life in self.unit.lives for line in life.lines]
        folder = f"{self.unit.output.parent}/"
        return [
            line.replace(folder, "")
            for line in lines
            if any(word in line for word in words)
            and not line.startswith(("health:", "camera     "))
        ]


def read_back(output: Path) -> list[list[int]]:
    """Return the numbers of the frames in all files, in their order, process by process."""
    rotated = sorted(output.parent.glob(f"{output.name}.*"), key=lambda path: int(path.suffix[1:]))
    lives: list[list[int]] = [[]]
    for path in [*rotated, output]:
        for record in read_records(path):
            if lives[-1] and record.seq <= lives[-1][-1]:
                lives.append([])
            lives[-1].append(record.seq)
    return lives


def account(life: Life, seqs: list[int]) -> dict[str, Any]:
    """Compare what a process says with what its files hold."""
    text = "\n".join(life.lines)
    told, written = ACCOUNT.search(text), WRITTEN.search(text)
    if told is None or written is None:
        return {"unsaid": None, "lines": life.lines[-3:]}
    delivered, frames, dropped_frames = map(int, told.groups())
    records, dropped_records = map(int, written.groups())
    return {
        "delivered": delivered,
        "frames": frames,
        "dropped_frames": dropped_frames,
        "records_said": records,
        "dropped_records": dropped_records,
        "records_read": len(seqs),
        "unsaid": delivered - dropped_frames - dropped_records - len(seqs),
    }


def ages(day: Day, output: Path) -> dict[str, int]:
    """Count the frames of the first connection, in which the process is stopped, by age and status.

    The n-th record is the n-th frame sent; the record says when its estimate was given. The clock
    of the process has not been set yet.
    """
    offset_s = time.time() - time.monotonic()
    counts = {"frames": 0, "ok": 0, "older than 1.1 s": 0, "older and ok": 0, "frame_stale": 0}
    for record in read_records(Path(f"{output}.1")):
        if record.seq >= day.first_connection:
            break
        given_s = 1e-9 * (record.stamp_ns or 0) + 1e-3 * record.latency_ms["total"]
        old = given_s - offset_s - day.camera.sent[record.seq] > 1.1
        counts["frames"] += 1
        counts["ok"] += record.status == "ok"
        counts["older than 1.1 s"] += old
        counts["older and ok"] += old and record.status == "ok"
        counts["frame_stale"] += "frame_stale" in record.reasons
    return counts


def main() -> int:
    """Play the day, read its files, report -> 1 if anything was lost unsaid."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--seconds", type=float, default=240.0, help="length of the day")
    parser.add_argument("--fps", type=float, default=15.0, help="frames per second of the camera")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder, disk = Path(name), Path(name) / "disk"
        disk.mkdir()
        mount = ["mount", "-t", "tmpfs", "-o", f"size={DISK_MIB}m", "tmpfs", str(disk)]
        subprocess.run(mount, check=True)
        try:
            camera = LoopbackCamera(arguments.fps, "off")
            unit = Unit(folder, disk, camera.address)
            day = Day(unit, camera, disk, arguments.seconds / HOURS)
            events = day.play()
            seqs = read_back(unit.output)
            found = ages(day, unit.output)
        finally:
            for life in unit.lives:
                life.process.kill()
            subprocess.run(["umount", "--lazy", str(disk)], check=True)
    lives = [account(*each) for each in zip(unit.lives, seqs, strict=True)]
    result = {
        "seconds": arguments.seconds,
        "fps": arguments.fps,
        "events": events,
        "lives": lives,
        "frames_sent": len(camera.sent),
        "exit_codes": day.codes,
        "unsaid": sum(life["unsaid"] for life in lives),
        "ages": found,
        "notices": dict(unit.notices),
        "watchdog": {"limit_s": WATCHDOG_S, "longest_s": round(unit.longest_s, 2)},
    }
    print(*lives, found, result["notices"], result["watchdog"], sep="\n")
    write_result(RESULTS / "service" / "day.json", result)
    return int(result["unsaid"] != 0 or found["older and ok"] != 0 or any(day.codes))


if __name__ == "__main__":
    sys.exit(main())
