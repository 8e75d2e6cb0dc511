"""One conformal method per file: its nonconformity score, and its inverse (threshold to set).

``HEADS`` is the registry. A new method needs one file here, one file of the same name on the
training side, and one line in each registry.
"""

from __future__ import annotations

from cvo_edge.heads.base import Candidate, Head
from cvo_edge.heads.cjp import CjpHead
from cvo_edge.heads.cqr import CqrHead
from cvo_edge.heads.csp import CspHead
from cvo_edge.heads.fused import FusedHead
from cvo_edge.heads.mcqr import McqrHead
from cvo_edge.heads.scr import ScrHead

__all__ = ["HEADS", "Candidate", "Head"]

HEADS: dict[str, type[Head]] = {
    head.method: head for head in (CjpHead, CqrHead, CspHead, McqrHead, ScrHead, FusedHead)
}
