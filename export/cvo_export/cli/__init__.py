"""The command line ``cvo-export``: argument parsing and exit codes only."""

from __future__ import annotations

from typing import NoReturn

from cvo_edge.process import guarded, quiet_libraries
from cvo_export.cli.app import app

# Importing a module registers its commands; help lists them in this order.
# isort: off
from cvo_export.cli import reconstruct, train, bundles, figures, studies

# isort: on

__all__ = ["app", "bundles", "figures", "main", "reconstruct", "studies", "train"]


def main() -> NoReturn:
    """Entry point of ``cvo-export``."""
    quiet_libraries()
    guarded("cvo-export", app)
