"""The methods' networks, one module per method, named as in ``cvo_edge.heads``.

``METHODS`` is the registry. A new method needs one module here, one of the same name in the
runtime, and one line in each registry.
"""

from __future__ import annotations

from cvo_export.networks.heads import cjp, cqr, csp, fused, mcqr, scr
from cvo_export.networks.heads.base import ExportedHead, Lessons, Method, Setting

__all__ = ["METHODS", "ExportedHead", "Lessons", "Method", "Setting"]

METHODS: dict[str, Method] = {
    "cjp": cjp.METHOD,
    "cqr": cqr.METHOD,
    "csp": csp.METHOD,
    "mcqr": mcqr.METHOD,
    "scr": scr.METHOD,
    "fused": fused.METHOD,
}
