"""Join a Ray cluster."""

from __future__ import annotations

import logging
import os
import signal
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from cvo_edge.errors import UsageError

# Ray takes minutes to notice that nothing listens at an address.
_SECONDS_TO_CONNECT = 5.0


@contextmanager
def ray_cluster(command: str, package: str) -> Iterator[Any]:
    """Join the cluster that ``RAY_ADDRESS`` names or that was started on this machine.

    Yields the module ``ray``. ``command`` and ``package`` are for messages: who asks, and whose
    extra ``ray`` is missing.

    Raises UsageError if ray is not installed or no cluster is found.
    """
    _take_the_heads_side()
    try:
        import ray
    except ImportError:
        raise UsageError(f'{command}: ray is not installed; pip install "{package}[ray]"') from None
    address = _address()
    if address is None or not _listening(address):
        raise UsageError(
            f"{command}: no Ray cluster at {address or 'any address'}; start one with "
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
        raise UsageError(f"{command}: cannot join the Ray cluster at {address}: {line}") from None
    try:
        yield ray
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
