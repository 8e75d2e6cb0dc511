"""Tasks on a Ray cluster: ``workers.run_tasks`` across machines.

All machines need the same packages and the study's folders at the same paths.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

from cvo_edge.cluster import ray_cluster
from cvo_edge.errors import CvoError
from cvo_export.study.workers import Ended, Engine, Task, TaskError, attempt

# Retries of a task, from its checkpoints, after its process or machine has died.
_RETRIES = 3


@contextmanager
def ray_engine() -> Iterator[Engine]:
    """Join the cluster that ``RAY_ADDRESS`` names or that was started on this machine.

    Yields a function that runs tasks by name, one per core; the others continue after a failure.

    Raises UsageError if ray is not installed or no cluster is found.
    """
    with ray_cluster("study", "cvo-export") as ray:
        yield partial(_run, ray)


def _run(ray: Any, tasks: Mapping[str, Task], ended: Ended) -> None:  # noqa: ANN401 - untyped
    remote = ray.remote(num_cpus=1, max_retries=_RETRIES)(_on_a_worker)
    running = {remote.remote(task, Path.cwd()): name for name, task in tasks.items()}
    while running:
        (reference, *_), _ = ray.wait(list(running), num_returns=1)
        try:
            found: CvoError | None = ray.get(reference)
        except ray.exceptions.RayError as error:
            found = TaskError(f"its worker was lost: {' '.join(str(error).split())[:200]}")
        ended(running.pop(reference), found)


def _on_a_worker(task: Task, folder: Path) -> CvoError | None:
    import torch

    torch.set_num_threads(1)
    # Resolve relative paths of data and weights as in the process that started the study.
    with suppress(OSError):
        os.chdir(folder)
    return attempt(task)
