"""Which splits and confidences a data set supports, before anything is trained."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, get_args

import numpy as np

from cvo_edge.bundle.format import CONFIDENCES
from cvo_edge.conformal import recording_cap
from cvo_edge.errors import UsageError
from cvo_edge.heads.plausible import Draws
from cvo_edge.vocabulary import Rule, SplitKind
from cvo_export.bundles.rule import chosen_rule
from cvo_export.data.splits import Split, default_kind, make_split
from cvo_export.datasets import PoseDataset


class Supported(NamedTuple):
    """A split of a data set with the default rule of its kind, or why there is none.

    ``draws`` counts what the rule counts; levels from ``finite`` have finite thresholds, in both
    scopes unless the joint one is ``bonferroni``. All three are None if the split is refused.
    """

    kind: SplitKind
    refusal: str
    split: Split | None = None
    rule: Rule | None = None
    draws: Draws | None = None

    @property
    def finite(self) -> tuple[float, ...]:
        """The stored confidences whose thresholds are finite if every frame passes the checks."""
        if self.draws is None:
            return ()
        return tuple(each for each in CONFIDENCES if self.draws.needed(each) <= self.draws.given)


def supported(dataset: PoseDataset, seed: int = 0) -> list[Supported]:
    """Try each kind of split as ``train`` makes it from this seed."""
    found = []
    for kind in get_args(SplitKind):
        try:
            split = make_split(dataset, kind, seed)
        except UsageError as error:
            found.append(Supported(kind, str(error)))
            continue
        rule, cap = chosen_rule(None, None, kind)
        counted = recording_cap(rule, cap)
        cal = split.roles["cal"]
        draws = Draws("frames", cal.size, 1.0)
        if counted is not None:
            draws = Draws("recordings", np.unique(dataset.sequence[cal]).size, counted)
        found.append(Supported(kind, "", split, rule, draws))
    return found


def supported_text(dataset: PoseDataset, found: Sequence[Supported]) -> list[str]:
    """Return lines for each kind of split: frames by role, levels, and what it costs."""
    usual, lines = default_kind(dataset), []
    for each in found:
        name = f"split       {each.kind}{' (default)' if each.kind == usual else ''}"
        if each.split is None or each.draws is None:
            lines.append(f"{name}: {each.refusal.removeprefix(f'split {each.kind}: ')}")
            continue
        roles = ", ".join(f"{role} {len(rows)}" for role, rows in each.split.roles.items())
        lost = len(dataset) - sum(len(rows) for rows in each.split.roles.values())
        lines.append(f"{name}: {roles}" + (f"; {lost} frames lost in gaps" if lost else ""))
        lines.append(f"            {_levels(each, each.draws)}")
        if each.split.blocks is not None and each.split.blocks.cost is not None:
            lines.append(f"            {each.split.blocks.cost}")
    return lines


def _units(draws: Draws) -> str:
    return f"{draws.given} {draws.unit[:-1] if draws.given == 1 else draws.unit}"


def _levels(each: Supported, draws: Draws) -> str:
    text = f"{each.rule} over {_units(draws)}: confidence "
    text += " ".join(f"{level:g}" for level in each.finite) or "none"
    missing = [level for level in CONFIDENCES if level not in each.finite]
    if missing:
        needs = ", ".join(f"{level:g} from {draws.needed(level)}" for level in missing)
        text += f"; unbounded: {needs} {draws.unit}"
    return text
