"""The program ``cvo-edge``, which an interrupt ends quietly also while it is being imported."""

from __future__ import annotations

import signal
from typing import NoReturn


def main() -> NoReturn:
    """Entry point of ``cvo-edge``."""
    # Unless whoever started it had it ignored.
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from cvo_edge.cli import main as run

    run()


if __name__ == "__main__":
    main()
