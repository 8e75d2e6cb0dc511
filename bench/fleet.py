"""``conformalize`` on many recordings: in one process, and on Ray with a worker killed on the way.

    python bench/fleet.py FOLDER [--recordings 1000] [--poses 2300]

Recordings are made of steps of the KITTI LiDAR odometry in ``CVO_DATA/trajectories``: blocks of 50
to 250 steps of truth and error, drawn with a seed, half of them mirrored, the errors of each
recording times a factor of its own; at most 2,300 poses each. FOLDER gets the files (0.4 GB a
thousand) and what each of the two runs took, unless it has them already.

The cluster is a head with two cores on this machine. Once 30 % of the alignments are done, the
worker that a task reports is killed in the middle of another one. Both files have to be equal.
``processor_s`` is that of the process and, with Ray, of all processes of the cluster; ``peak_mb``
that of the process which merges, with what it maps of the object store. Results:
``results/motion/fleet.json``.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from motion import kitti
from numpy.typing import NDArray
from provenance import RESULTS, write_result

from cvo_edge import geometry
from cvo_edge.cluster import ray_cluster
from cvo_edge.motion.format import encode_motion_file
from cvo_edge.motion.relative import motion, residual, rotated
from cvo_edge.programs.conformalize import Wanted, learn
from cvo_edge.programs.trajectories import Reading, listed_files
from cvo_edge.spread import Here, OnRay

Array = NDArray[np.float64]

POSES, FPS, SEED = 2300, 9.65, 24
BLOCK = (50, 250)
# x is to the right in KITTI's camera frame: a mirror changes it, and turns about the other axes.
MIRROR = np.array([-1.0, 1.0, 1.0, 1.0, -1.0, -1.0])
KILLED_AT = 0.3
RAY = Path(sys.executable).with_name("ray")


def composed(first: Array, second: Array) -> Array:
    """Poses (n, 7) and motions (n, 7) -> the poses after the motions."""
    t_m = first[:, :3] + rotated(first[:, 3:], second[:, :3])
    q = geometry.quaternion_multiply(first[:, 3:], second[:, 3:])
    return np.concatenate([t_m, geometry.quaternion_normalise(q)], axis=1)


def exp(numbers: Array) -> Array:
    """Numbers (..., 6), m and rad -> motions (..., 7)."""
    return np.concatenate([numbers[..., :3], geometry.quaternion_exp(numbers[..., 3:])], axis=-1)


def drawn(
    generator: np.random.Generator, sources: list[tuple[Array, Array]]
) -> tuple[Array, Array]:
    """Return the truth's steps and the errors of a recording, (POSES - 1, 6) each."""
    steps, errors, count = [], [], 0
    while count < POSES - 1:
        true, off = sources[generator.integers(len(sources))]
        length = int(generator.integers(*BLOCK))
        first = int(generator.integers(len(true) - length))
        sign = MIRROR if generator.random() < 0.5 else 1.0
        steps.append(sign * true[first : first + length])
        errors.append(sign * off[first : first + length])
        count += length
    factor = generator.lognormal(0.0, 0.3)
    cut = slice(POSES - 1)
    return np.concatenate(steps)[cut], factor * np.concatenate(errors)[cut]


def write(folder: Path, count: int, length: int) -> None:
    """Write recordings, then the list of their files."""
    nothing = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    sources = []
    for pair in kitti():
        true = motion(pair.truth[:-1], pair.truth[1:])
        off = residual(motion(pair.estimate[:-1], pair.estimate[1:]), true)
        sources.append((residual(np.tile(nothing, (len(true), 1)), true), off))
    generator = np.random.default_rng(SEED)
    parts = [drawn(generator, sources) for _ in range(count)]
    true = exp(np.array([steps for steps, _ in parts]))
    # With x of dE^-1 dG, dE is dG Exp(x)^-1.
    back = motion(exp(np.array([off for _, off in parts])), nothing)
    stamps = np.arange(POSES) / FPS
    names = [(f"{index:04d}.tum", f"{index:04d}-truth.tum") for index in range(count)]
    for place in (0, 1):
        poses = np.tile(nothing, (POSES, count, 1))
        for step in range(POSES - 1):
            poses[step + 1] = composed(poses[step], true[:, step])
            if place == 0:
                poses[step + 1] = composed(poses[step], composed(true[:, step], back[:, step]))
        for index, name in enumerate(names):
            table = np.column_stack([stamps, poses[:, index]])
            np.savetxt(folder / name[place], table[:length], fmt="%.9f")
    (folder / "pairs.txt").write_text("".join(f"{' '.join(name)}\n" for name in names))


def driver(listed: Path, output: Path, address: str | None) -> None:
    """Calibrate in this process or on a cluster, and print what it took, as JSON."""
    stages: dict[str, list[float]] = {}
    killed: list[int] = []

    def watch(what: str, done: int, total: int, ray: Any = None) -> None:  # noqa: ANN401
        stages.setdefault(what, [time.perf_counter()]).append(time.perf_counter())
        if ray and what == "alignment" and done >= KILLED_AT * total and not killed:
            killed.append(kill_a_worker(ray))

    wanted = Wanted("fleet", None, None, True, (), ())
    files = listed_files([], listed, [])
    begin = time.perf_counter()
    if address is None:
        found = learn(files, Reading(), wanted, partial(Here, watch=watch))
    else:
        os.environ.update(RAY_ADDRESS=address)
        with ray_cluster("bench", "cvo-edge") as ray:
            told = partial(watch, ray=ray)
            found = learn(files, Reading(), wanted, partial(OnRay.of, ray, watch=told))
    output.write_bytes(encode_motion_file(found.file))
    usage = resource.getrusage(resource.RUSAGE_SELF)
    report = {
        "engine": "ray" if address else "local",
        "seconds": time.perf_counter() - begin,
        "stages": {what: times[-1] - times[0] for what, times in stages.items()},
        "driver_processor_s": usage.ru_utime + usage.ru_stime,
        "peak_mb": usage.ru_maxrss / 1024.0,
        "killed": len(killed),
    }
    print(json.dumps(report))


def kill_a_worker(ray: Any) -> int:  # noqa: ANN401 - untyped
    """Kill the process that a task reports, once it is at work on another one."""
    pid: int = ray.get(ray.remote(num_cpus=1)(own_pid).remote())
    command = Path(f"/proc/{pid}/cmdline")
    while b"_on_a_worker" not in command.read_bytes():
        time.sleep(0.01)
    os.kill(pid, signal.SIGKILL)
    return pid


def own_pid() -> int:
    """Return the number of the process that runs this."""
    return os.getpid()


def stat(pid: int) -> tuple[int, float] | None:
    """Return parent and processor seconds of a process; None if it is gone."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return None
    return int(fields[1]), (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def family(root: int) -> dict[int, float]:
    """Return the processor seconds of a process and of those that descend from it, by pid."""
    every = {int(path.name): stat(int(path.name)) for path in Path("/proc").glob("[0-9]*")}
    known = {pid: found for pid, found in every.items() if found}
    own, before = {root}, 0
    while len(own) > before:
        before = len(own)
        own |= {pid for pid, (parent, _) in known.items() if parent in own}
    return {pid: known[pid][1] for pid in own if pid in known}


@contextmanager
def head() -> Iterator[tuple[str, int]]:
    """Start a head with two cores on this machine alone; yield its address and pid."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    os.environ["RAY_AUTH_MODE"] = "disabled"
    # By default, anything else on the machine goes before workers.
    plain = {"RAY_AUTH_MODE": "disabled", "RAY_worker_niceness": "0"}
    words = [f"--port={address.split(':')[1]}", "--node-ip-address=127.0.0.1", "--num-cpus=2"]
    words += ["--include-dashboard=false", "--disable-usage-stats"]
    command = [RAY, "start", "--head", "--block", *words, f"--object-store-memory={4 << 30}"]
    with subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=os.environ | plain
    ) as process:
        try:
            check = [RAY, "health-check", "--address", address]
            while subprocess.run(check, check=False, capture_output=True).returncode:
                if process.poll() is not None:
                    raise SystemExit("the head ended")
            yield address, process.pid
        finally:
            process.terminate()


def run(listed: Path, output: Path) -> dict[str, Any]:
    """Calibrate in another process; return what it took."""
    command = [sys.executable, __file__, str(listed.parent), "--driver", str(output)]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    report = dict(json.loads(done.stdout.splitlines()[-1]))
    return report | {"processor_s": report["driver_processor_s"]}


def run_on_ray(listed: Path, output: Path) -> dict[str, Any]:
    """Do the same on a cluster, one of whose workers is killed."""
    with head() as (address, pid):
        command = [sys.executable, __file__, str(listed.parent), "--driver", str(output)]
        seconds: dict[int, float] = {}
        with subprocess.Popen(
            [*command, "--address", address], stdout=subprocess.PIPE, text=True
        ) as process:
            while process.poll() is None:
                # Workers end with their driver: what they took is read while they live.
                seconds |= family(pid)
                time.sleep(0.5)
            assert process.stdout is not None
            lines = process.stdout.read().splitlines()
        assert process.returncode == 0
    report = dict(json.loads(lines[-1]))
    return report | {"processor_s": report["driver_processor_s"] + sum(seconds.values())}


def once(path: Path, measure: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """Return what was measured before, or measure it now: a thousand recordings take a while."""
    if not path.exists():
        path.write_text(json.dumps(measure()))
    return dict(json.loads(path.read_text()))


def main() -> None:
    """Write recordings, calibrate twice, compare."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--recordings", type=int, default=1000)
    parser.add_argument("--poses", type=int, default=POSES, help="of each, at most %(default)s")
    parser.add_argument("--driver", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--address", help=argparse.SUPPRESS)
    given = parser.parse_args()
    listed = given.folder / "pairs.txt"
    if given.driver:
        driver(listed, given.driver, given.address)
        return
    given.folder.mkdir(parents=True, exist_ok=True)
    known = listed.read_text().splitlines() if listed.exists() else []
    if len(known) != given.recordings:
        write(given.folder, given.recordings, given.poses)
    local, ray = given.folder / "local.json", given.folder / "ray.json"
    runs = [
        once(given.folder / "local.run", partial(run, listed, local)),
        once(given.folder / "ray.run", partial(run_on_ray, listed, ray)),
    ]
    assert local.read_bytes() == ray.read_bytes(), "the files differ"
    assert [each["killed"] for each in runs] == [0, 1]
    report = {
        "recordings": given.recordings,
        "poses": given.recordings * given.poses,
        "bytes": local.stat().st_size,
        "equal": True,
        "runs": runs,
    }
    write_result(RESULTS / "motion" / "fleet.json", report)


if __name__ == "__main__":
    main()
