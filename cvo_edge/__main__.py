"""The program ``cvo-edge``; an interrupt during start-up ends it without a traceback."""

from __future__ import annotations

import signal
from typing import NoReturn


def main() -> NoReturn:
    """Entry point of ``cvo-edge``."""
    # Keep SIGINT ignored if the parent process ignores it.
    interruptible = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if interruptible:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from cvo_edge import process

    process.check_memory("cvo-edge")
    process.prepare_environment()
    from cvo_edge.programs.cli import main as run

    if interruptible:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    process.keep_libraries_off_stderr()
    process.end_within_a_second()
    process.follow_hang_ups()
    run()


if __name__ == "__main__":
    main()
