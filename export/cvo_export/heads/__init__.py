"""The networks, one method a file, of the same names as in ``cvo_edge.heads``."""

from __future__ import annotations
