"""Tasks on a Ray cluster: the same as ``workers.run_tasks``, on as many machines as it has.

All machines see the folders of the study under the same paths, and have the same packages.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping

from cvo_edge.errors import CvoError, UsageError
from cvo_export.workers import Ended, Task, TaskError, attempt

# A task whose process or machine dies is run again, from its checkpoints, so many times.
_RETRIES = 3


def run_tasks_on_ray(tasks: Mapping[str, Task], ended: Ended) -> None:
    """Run tasks by name, one a core; one that fails does not keep the others from running.

    Joins the cluster that ``RAY_ADDRESS`` names or that was started on this machine.

    Raises UsageError where ray is not installed or there is no cluster.
    """
    try:
        import ray
    except ImportError:
        raise UsageError('study: expected ray, found none; pip install "cvo-export[ray]"') from None
    try:
        # Tasks say themselves what they have to say.
        ray.init(address="auto", log_to_driver=False, logging_level=logging.ERROR)
    except ConnectionError:
        raise UsageError(
            "study: expected a Ray cluster, found none; start one: ray start --head"
        ) from None
    try:
        remote = ray.remote(num_cpus=1, max_retries=_RETRIES)(_on_a_worker)
        running = {remote.remote(task): name for name, task in tasks.items()}
        while running:
            (reference, *_), _ = ray.wait(list(running), num_returns=1)
            try:
                found: CvoError | None = ray.get(reference)
            except ray.exceptions.RayError as error:
                found = TaskError(f"its worker was lost: {' '.join(str(error).split())[:200]}")
            ended(running.pop(reference), found)
    finally:
        ray.shutdown()


def _on_a_worker(task: Task) -> CvoError | None:
    import torch

    torch.set_num_threads(1)
    return attempt(task)
