"""What a service tells systemd: the protocol of sd_notify(3), a datagram to a Unix socket."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Mapping

# systemd reads at once; a service must not wait for one that does not.
_PATIENCE_S = 1.0


class Notifier:
    """Tells systemd how a service is; without ``NOTIFY_SOCKET``, it tells nobody.

    Attributes
    ----------
    watchdog_s
        The time within which systemd expects ``alive``, None if it expects nothing.
    """

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        address = environment.get("NOTIFY_SOCKET", "")
        # An abstract address begins with a zero byte, which a variable cannot hold.
        self._address = f"\0{address[1:]}" if address.startswith("@") else address
        self._stopping = False
        limit_us = environment.get("WATCHDOG_USEC", "")
        mine = environment.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        self.watchdog_s = 1e-6 * int(limit_us) if mine and limit_us.isdecimal() else None

    def ready(self, status: str) -> None:
        """Say that the service has started, or has reloaded."""
        self._tell("READY=1", f"STATUS={status}")

    def reloading(self) -> None:
        """Say that the service reloads; ``ready`` follows."""
        self._tell("RELOADING=1", f"MONOTONIC_USEC={time.monotonic_ns() // 1000}")

    def status(self, text: str) -> None:
        """Say one line about the state of the service."""
        self._tell(f"STATUS={text}")

    def alive(self) -> None:
        """Reset the watchdog."""
        self._tell("WATCHDOG=1")

    def stopping(self) -> None:
        """Say that the service ends, once."""
        if not self._stopping:
            self._tell("STOPPING=1")
        self._stopping = True

    def _tell(self, *lines: str) -> None:
        if not self._address:
            return
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
                sender.settimeout(_PATIENCE_S)
                sender.sendto("\n".join(lines).encode(), self._address)
        except OSError:
            # The watchdog ends a service that cannot be heard.
            return
