"""Which processor cores this process may use, and which one each inference thread gets."""

from __future__ import annotations

import math
import os
from pathlib import Path, PurePosixPath

from cvo_edge.errors import UsageError

MAX_THREADS = 64


def allowed_cores() -> int:
    """Return the number of processor cores this process may use.

    The smaller of its affinity and of its control group's quota, as containers have it; a part of a
    core counts as one.
    """
    cores = os.cpu_count() or 1
    if hasattr(os, "sched_getaffinity"):
        cores = len(os.sched_getaffinity(0))
    return max(1, math.ceil(min(cores, cgroup_cores())))


def cgroup_cores(
    groups: Path = Path("/proc/self/cgroup"), mount: Path = Path("/sys/fs/cgroup")
) -> float:
    """Cores' worth of time that this process's control groups allow, infinite without a quota.

    ``groups`` names its groups, ``mount`` is where they are; of version 2, or of version 1 in the
    folder ``cpu``.
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
        # A group has no more than each one that it is in.
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
        # "max" and -1 are no quota.
        return int(quota) / int(period) if int(quota) > 0 else math.inf
    except (OSError, ValueError, ZeroDivisionError):
        return math.inf


def checked_threads(threads: int | None) -> int:
    """Return a number of threads, by default one for each allowed core; raises UsageError."""
    # The engine would take a thousand, and minutes for a frame.
    if threads is not None and not (isinstance(threads, int) and 1 <= threads <= MAX_THREADS):
        raise UsageError(f"threads: expected 1 to {MAX_THREADS}, found {threads!r}")
    return threads or allowed_cores()


def cores_of_threads(threads: int) -> list[int]:
    """Return a core for each thread of an inference, or none where they had better be free.

    Only where there are as many threads as cores. A thread that wakes up is often put on the core
    of the one that woke it, while another is idle, and there they take turns.
    """
    if threads < 2 or not hasattr(os, "sched_getaffinity"):
        return []
    cores = sorted(os.sched_getaffinity(0))
    return cores if threads == len(cores) else []
