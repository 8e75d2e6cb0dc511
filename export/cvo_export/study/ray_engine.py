"""Tasks on a Ray cluster: ``workers.run_tasks`` across machines.

All machines need the same packages and the study's folders at the same paths.
"""

from __future__ import annotations

import logging
import os
import signal
import socket
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

from cvo_edge.errors import CvoError, UsageError
from cvo_export.study.workers import Ended, Engine, Task, TaskError, attempt

# Retries of a task, from its checkpoints, after its process or machine has died.
_RETRIES = 3


# Ray takes minutes to notice that nothing listens at an address.
_SECONDS_TO_CONNECT = 5.0


@contextmanager
def ray_engine() -> Iterator[Engine]:
    """Join the cluster that ``RAY_ADDRESS`` names or that was started on this machine.

    Yields a function that runs tasks by name, one per core; the others continue after a failure.

    Raises UsageError if ray is not installed or no cluster is found.
    """
    _take_the_heads_side()
    try:
        import ray
    except ImportError:
        raise UsageError('study: ray is not installed; pip install "cvo-export[ray]"') from None
    address = _address()
    if address is None or not _listening(address):
        raise UsageError(
            f"study: no Ray cluster at {address or 'any address'}; start one with "
            "ray start --head, or name one in RAY_ADDRESS as HOST:PORT"
        )
    handlers = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        # Tasks print their own progress.
        ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR)
        # Ray installs its own signal handlers, which use another exit code.
        for number, handler in handlers.items():
            signal.signal(number, handler)
    except (ConnectionError, ValueError, RuntimeError) as error:
        line = next(iter(str(error).splitlines()), type(error).__name__)
        raise UsageError(f"study: cannot join the Ray cluster at {address}: {line}") from None
    try:
        yield partial(_run, ray)
    finally:
        ray.shutdown()


def _take_the_heads_side() -> None:
    """Use token authentication whenever ``ray start`` does: if the user has a token, by default.

    Ray reads the variable when it is imported.
    """
    kept = Path("~/.ray/auth_token").expanduser()
    named = "RAY_AUTH_TOKEN" in os.environ or "RAY_AUTH_TOKEN_PATH" in os.environ
    if "RAY_AUTH_MODE" not in os.environ and (named or kept.exists()):
        os.environ["RAY_AUTH_MODE"] = "token"


def _address() -> str | None:
    """HOST:PORT of a cluster: from the environment, otherwise of this machine's last head."""
    named = os.environ.get("RAY_ADDRESS", "auto")
    if named != "auto":
        return named
    found = Path(os.environ.get("RAY_TMPDIR", "/tmp")) / "ray" / "ray_current_cluster"  # noqa: S108
    try:
        return found.read_text("utf-8").strip() or None
    except OSError:
        return None


def _listening(address: str) -> bool:
    host, _, port = address.rpartition(":")
    try:
        socket.create_connection((host, int(port)), _SECONDS_TO_CONNECT).close()
    except (OSError, ValueError, OverflowError):
        return False
    return True


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
