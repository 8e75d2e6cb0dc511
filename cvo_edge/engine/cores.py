"""The processor cores that this process may use, and the core of each inference thread."""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Iterable
from pathlib import Path, PurePosixPath

from cvo_edge.errors import UsageError
from cvo_edge.given import given_count

MAX_THREADS = 64


def allowed_cores() -> int:
    """Return the number of processor cores this process may use.

    This is the smaller of its CPU affinity and its control group's quota (set for containers),
    rounded up.
    """
    cores = os.cpu_count() or 1
    if hasattr(os, "sched_getaffinity"):
        cores = len(os.sched_getaffinity(0))
    return max(1, math.ceil(min(cores, cgroup_cores())))


def cgroup_cores(
    groups: Path = Path("/proc/self/cgroup"), mount: Path = Path("/sys/fs/cgroup")
) -> float:
    """Return the CPU quota of this process's control groups in cores; infinite without a quota.

    ``groups`` is the file that lists the groups, ``mount`` the root of the cgroup file system
    (version 2, or version 1 in the folder ``cpu``).
    """
    least = math.inf
    try:
        lines = groups.read_text("utf-8").splitlines()
    except OSError:
        return least
    for line in lines:
        _, controllers, path = line.split(":", 2)
        if controllers and "cpu" not in controllers.split(","):
            continue
        root = mount / "cpu" if controllers else mount
        group = PurePosixPath(path.lstrip("/"))
        # The quota of every parent group applies, too.
        for part in (group, *group.parents):
            least = min(least, _group_cores(root / part))
    return least


def _group_cores(folder: Path) -> float:
    try:
        if (folder / "cpu.max").exists():
            quota, period = (folder / "cpu.max").read_text("ascii").split()
        else:
            quota = (folder / "cpu.cfs_quota_us").read_text("ascii")
            period = (folder / "cpu.cfs_period_us").read_text("ascii")
        # "max" and -1 mean that there is no quota.
        return int(quota) / int(period) if int(quota) > 0 else math.inf
    except (OSError, ValueError, ZeroDivisionError):
        return math.inf


def checked_threads(threads: int | None) -> int:
    """Return the number of threads, by default one per allowed core; raises UsageError."""
    # The engine accepts a thousand threads, and then takes minutes per frame.
    if threads is None:
        return allowed_cores()
    count = given_count(threads, "threads")
    if not 1 <= count <= MAX_THREADS:
        raise UsageError(f"threads: expected 1 to {MAX_THREADS}, found {threads!r}")
    return count


def cores_of_threads(threads: int, taken: Iterable[int] = ()) -> list[int]:
    """Return one core per inference thread, or an empty list to leave the threads unpinned.

    Threads are pinned only if there are as many threads as cores. Without pinning, the scheduler
    often runs a woken thread on the core of the thread that woke it while another core is idle. The
    first core is the caller's: the one that is least often among those ``taken`` by other callers.
    """
    if threads < 2 or not hasattr(os, "sched_getaffinity"):
        return []
    cores = sorted(os.sched_getaffinity(0))
    if threads != len(cores):
        return []
    counts = Counter(taken)
    first = min(cores, key=lambda core: counts[core])
    return [first, *(core for core in cores if core != first)]
