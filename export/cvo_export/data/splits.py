"""Split a data set into roles. A frame never has two roles.

``train`` fits the networks; ``fit`` is for models of residuals (CJP trains on train and fit
together); ``val`` decides every choice (early stopping, score, scales); ``cal`` gives the
thresholds and nothing else; ``test`` gives the final figures and nothing else. A split for
calibrating an existing network on new data has no ``train`` and no ``fit``. In a crossed run, the
recordings of ``train``, ``fit`` and ``cal`` all train and all give thresholds.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from cvo_edge.bundle.format import SplitSpec
from cvo_edge.errors import SourceError, UsageError
from cvo_edge.files import write_whole
from cvo_edge.vocabulary import SplitKind
from cvo_export.datasets import PoseDataset

Purpose = Literal["training", "calibration"]
SHARES: dict[Purpose, dict[str, float]] = {
    "training": {"train": 0.4, "fit": 0.1, "val": 0.1, "cal": 0.2, "test": 0.2},
    "calibration": {"val": 0.1, "cal": 0.7, "test": 0.2},
}

# Blocks of a recording, and frames dropped at a border between blocks of different roles. The first
# that leaves enough frames is used: a short recording gets fewer blocks, then narrower gaps.
_BLOCKS = (
    *((20, 15), (15, 15), (12, 15), (10, 15)),
    *((10, gap) for gap in (12, 10, 8, 6, 5, 4, 3)),
)
_LEAST_SURVIVING = 0.6
# Fewer frames in a role, e.g. nine of cal for the level 0.9, decide nothing.
_ENOUGH = 9
# The hierarchical rule is finite at 0.9, and capped at 0.95, from nine recordings. With two more,
# they are finite without one of them, too.
_CALIBRATION_SEQUENCES, _MANY_SEQUENCES = 11, 30

Indices = NDArray[np.int64]


class Blocks(NamedTuple):
    """Blocks of a split: how many, and the frames dropped where neighbours differ in role."""

    pieces: int
    gap: int

    @property
    def cost(self) -> str | None:
        """What a recording too short for usual blocks costs, or None."""
        usual = Blocks(*_BLOCKS[0])
        if self.gap == usual.gap:
            return None
        return (
            f"frames of different roles are {self.gap} frames apart instead of {usual.gap}, so "
            "coverage and errors may look better than on new frames"
        )


@dataclass(frozen=True)
class Split:
    """Ascending frame numbers by role; frames in gaps between blocks have no role.

    ``blocks`` describes a split by block, and is None for the others.
    """

    kind: SplitKind
    seed: int
    purpose: Purpose
    roles: Mapping[str, Indices]
    blocks: Blocks | None = None

    def digest(self, dataset: PoseDataset) -> str:
        """Return a sha256 over frame names and poses by role, which identifies the split.

        Poses are rounded to 1e-4 (m, quaternion), so that a reader's rounding does not matter.
        """
        digest = hashlib.sha256(json.dumps(self._names(dataset), sort_keys=True).encode())
        for role in sorted(self.roles):
            digest.update(np.round(dataset.poses[self.roles[role]] * 1e4).astype("<i8").tobytes())
        return digest.hexdigest()

    def spec(self, dataset: PoseDataset) -> SplitSpec:
        """Return the description of the split that a bundle stores."""
        return SplitSpec(
            purpose=self.purpose, kind=self.kind, seed=self.seed, sha256=self.digest(dataset)
        )

    def write(self, path: Path, dataset: PoseDataset) -> None:
        """Write kind, seed and the frame names of every role as JSON; raises SinkError."""
        document = {
            **msgspec.to_builtins(self.spec(dataset)),
            "roles": self._names(dataset),
        }
        write_whole(path, json.dumps(document, indent=1) + "\n")

    def _names(self, dataset: PoseDataset) -> dict[str, list[str]]:
        return {
            role: [dataset.frame_names[index] for index in indices]
            for role, indices in self.roles.items()
        }


def read_split_spec(path: Path) -> SplitSpec:
    """Read a file that ``Split.write`` wrote, without the frame names."""
    document = msgspec.json.decode(path.read_bytes())
    del document["roles"]
    return msgspec.convert(document, SplitSpec)


def make_split(
    dataset: PoseDataset, kind: SplitKind, seed: int, purpose: Purpose = "training"
) -> Split:
    """Assign every frame at most one role.

    ``random`` assigns single frames, which are exchangeable by construction but give optimistic
    figures on video. ``block`` assigns contiguous blocks and drops frames where roles change: 20
    blocks and 15 frames, or fewer if the recordings are short.
    ``sequence`` assigns whole sequences and respects the data set's own test list. A calibration
    split uses only the sequences on the data set's own test list, if it has one, because networks
    are trained on the others. The same data set and arguments give the same split.

    Raises UsageError if the data set is too small for the kind of split.
    """
    generator = np.random.default_rng(seed)
    frames = np.arange(len(dataset))
    dealt = dataset
    if purpose == "calibration" and dataset.own_test:
        frames = np.flatnonzero(np.isin(dataset.sequence, sorted(dataset.own_test)))
        dealt = _part(dataset, frames)
    blocks = None
    if kind == "random":
        roles = _random(dealt, generator, SHARES[purpose])
    elif kind == "block":
        roles, blocks = _block(dealt, generator, SHARES[purpose])
    else:
        roles = _sequence(dealt, generator, SHARES[purpose])
    roles = {role: frames[indices] for role, indices in roles.items()}
    empty = [role for role, indices in roles.items() if indices.size == 0]
    if empty:
        recordings = np.unique(dealt.sequence).size
        raise UsageError(
            f"split {kind}: expected frames for every role, found none for {', '.join(empty)} "
            f"among {frames.size} frames in {recordings} sequence{'s' * (recordings != 1)}"
        )
    return Split(kind, seed, purpose, roles, blocks)


def default_kind(dataset: PoseDataset, purpose: Purpose = "training") -> SplitKind:
    """Return ``sequence`` if there are enough sequences for the roles, otherwise ``block``."""
    sequences = len(dataset.sequence_names)
    if purpose == "calibration" and dataset.own_test:
        sequences = len(dataset.own_test)
    return "sequence" if sequences >= len(SHARES[purpose]) else "block"


def same_split(dataset: PoseDataset, recorded: SplitSpec) -> Split:
    """Reproduce a recorded split; raises SourceError if the data set is not the same."""
    split = make_split(dataset, recorded.kind, recorded.seed, recorded.purpose)
    found = split.digest(dataset)
    if found != recorded.sha256:
        raise SourceError(
            f"{dataset.name}: expected the data set of the recorded {recorded.kind} split "
            f"(sha256 {recorded.sha256[:12]}...), found another data set ({found[:12]}...); "
            "--subset all needs no split"
        )
    return split


def deal_folds(dataset: PoseDataset, split: Split, indices: Indices, count: int) -> list[Indices]:
    """Divide positions within ``indices`` (frame numbers) into folds, by the unit of the split.

    The unit is a frame for a random split. Otherwise it is a sequence or, if there are too few
    sequences, a run of consecutive frames, because neighbouring frames in different folds would
    leak information.
    """
    unit = np.arange(indices.size)
    if split.kind != "random":
        unit = dataset.sequence[indices]
        if np.unique(unit).size < count:
            unit = np.cumsum(np.diff(indices, prepend=indices[:1]) != 1)
        if np.unique(unit).size < count:
            unit = np.arange(indices.size) * 3 * count // indices.size
    names, unit = np.unique(unit, return_inverse=True)
    fold_of = np.random.default_rng((split.seed, count)).permutation(names.size) % count
    return [np.flatnonzero(fold_of[unit] == number) for number in range(count)]


def training_frames(dataset: PoseDataset, split: Split, share: float) -> tuple[Indices, Indices]:
    """Return the frame numbers of train and fit, or of a share of each.

    The split's seed draws single frames, whole sequences or runs of consecutive frames, according
    to the kind of split; each role keeps at least one. A smaller share is a subset of a larger one.
    """
    if share == 1.0:
        return split.roles["train"], split.roles["fit"]
    found = []
    for number, role in enumerate(("train", "fit")):
        indices = split.roles[role]
        unit = np.arange(indices.size)
        if split.kind == "sequence":
            unit = dataset.sequence[indices]
        elif split.kind == "block":
            unit = np.cumsum(np.diff(indices, prepend=indices[:1]) != 1)
        names = np.unique(unit)
        order = np.random.default_rng((split.seed, number)).permutation(names)
        found.append(indices[np.isin(unit, order[: max(1, round(share * names.size))])])
    return found[0], found[1]


def crossed_frames(dataset: PoseDataset, split: Split) -> Indices:
    """Return the frame numbers of train, fit and cal, which all train in a crossed run.

    Whole recordings one after the other, in an order that the split's seed draws.
    """
    indices = np.concatenate([split.roles[role] for role in ("train", "fit", "cal")])
    recordings = np.unique(dataset.sequence[indices])
    rank = np.random.default_rng((split.seed, len(indices))).permutation(recordings.size)
    place = rank[np.searchsorted(recordings, dataset.sequence[indices])]
    return indices[np.lexsort((indices, place))]


def crossed_folds(dataset: PoseDataset, split: Split, count: int) -> list[Indices]:
    """Divide the recordings of a crossed run into folds; returns their frame numbers."""
    indices = crossed_frames(dataset, split)
    return [indices[fold] for fold in deal_folds(dataset, split, indices, count)]


def network_rows(dataset: PoseDataset, indices: Indices) -> int:
    """Return how many of these frames train the network where models of residuals need others.

    The rest, about a fifth, are the last recordings in the order of ``indices``, or the last frames
    if there is a single recording.
    """
    shares = SHARES["training"]
    kept = shares["train"] / (shares["train"] + shares["fit"])
    starts = np.flatnonzero(np.diff(dataset.sequence[indices], prepend=-1))
    if starts.size == 1:
        return int(kept * indices.size)
    return int(starts[min(starts.size - 1, max(1, round(kept * starts.size)))])


def _counts(total: int, shares: Mapping[str, float]) -> dict[str, int]:
    """Divide ``total`` into whole numbers by largest remainder, each at least 1 if possible."""
    exact = {role: total * share / sum(shares.values()) for role, share in shares.items()}
    counts = {role: int(value) for role, value in exact.items()}
    by_remainder = sorted(exact, key=lambda role: counts[role] - exact[role])
    for role in by_remainder[: total - sum(counts.values())]:
        counts[role] += 1
    if total >= len(counts):
        while not all(counts.values()):
            counts[max(counts, key=lambda role: counts[role])] -= 1
            counts[min(counts, key=lambda role: counts[role])] += 1
    return counts


def _part(dataset: PoseDataset, frames: Indices) -> PoseDataset:
    """Return a data set of these frames, numbered from 0, without its own train and test lists."""
    return replace(
        dataset,
        poses=dataset.poses[frames],
        sequence=dataset.sequence[frames],
        frame_names=tuple(dataset.frame_names[index] for index in frames.tolist()),
        own_train=frozenset(),
        own_test=frozenset(),
    )


def _deal(items: Indices, counts: Mapping[str, int]) -> dict[str, Indices]:
    stops = np.cumsum(list(counts.values()))
    return dict(zip(counts, np.split(items, stops[:-1]), strict=True))


def _random(
    dataset: PoseDataset, generator: np.random.Generator, shares: Mapping[str, float]
) -> dict[str, Indices]:
    shuffled = generator.permutation(len(dataset))
    dealt = _deal(shuffled, _counts(len(dataset), shares))
    return {role: np.sort(indices) for role, indices in dealt.items()}


def _block(
    dataset: PoseDataset, generator: np.random.Generator, shares: Mapping[str, float]
) -> tuple[dict[str, Indices], Blocks]:
    surviving = 0
    for least in (_ENOUGH, 1):
        for count, gap in _BLOCKS:
            roles = _in_blocks(dataset, generator, shares, count, gap)
            sizes = [indices.size for indices in roles.values()]
            surviving = sum(sizes)
            if surviving >= _LEAST_SURVIVING * len(dataset) and min(sizes) >= least:
                return roles, Blocks(count, gap)
    raise UsageError(
        f"split block: expected at least {_LEAST_SURVIVING:.0%} of the frames to remain after gaps "
        f"of {_BLOCKS[-1][1]} frames, found {surviving} of {len(dataset)}; the recording is too "
        "short; --split random assigns single frames"
    )


def _in_blocks(
    dataset: PoseDataset,
    generator: np.random.Generator,
    shares: Mapping[str, float],
    count: int,
    gap: int,
) -> dict[str, Indices]:
    """Deal about ``count`` blocks; drop the last and first frames where neighbours differ."""
    blocks: list[Indices] = []
    for number in range(len(dataset.sequence_names)):
        frames = np.flatnonzero(dataset.sequence == number)
        pieces = max(1, round(count * frames.size / len(dataset)))
        blocks += [block for block in np.array_split(frames, pieces) if block.size]
    dealt = _deal(generator.permutation(len(blocks)), _counts(len(blocks), shares))
    role_of = {int(block): role for role, members in dealt.items() for block in members}
    roles: dict[str, list[Indices]] = {role: [] for role in shares}
    for index, block in enumerate(blocks):
        start = gap - gap // 2 if _border(dataset, blocks, role_of, index - 1) else 0
        stop = block.size - (gap // 2 if _border(dataset, blocks, role_of, index) else 0)
        roles[role_of[index]].append(block[start : max(start, stop)])
    empty = np.empty(0, np.int64)
    return {role: np.concatenate(parts) if parts else empty for role, parts in roles.items()}


def _border(
    dataset: PoseDataset, blocks: list[Indices], role_of: Mapping[int, str], index: int
) -> bool:
    """Return whether blocks ``index`` and ``index + 1`` are adjacent and differ in role."""
    if not 0 <= index < len(blocks) - 1:
        return False
    same = dataset.sequence[blocks[index][0]] == dataset.sequence[blocks[index + 1][0]]
    return bool(same) and role_of[index] != role_of[index + 1]


def _sequence(
    dataset: PoseDataset, generator: np.random.Generator, shares: Mapping[str, float]
) -> dict[str, Indices]:
    everything = np.unique(dataset.sequence).tolist()
    test = np.array(sorted(dataset.own_test), dtype=np.int64)
    pool = sorted((dataset.own_train or frozenset(everything)) - dataset.own_test)
    shuffled = generator.permutation(np.array(pool, dtype=np.int64))
    dealt_shares = dict(shares)
    if test.size:
        del dealt_shares["test"]
    counts = _counts(shuffled.size, dealt_shares)
    if "fit" in shares and len(everything) >= _MANY_SEQUENCES:
        counts = _more_calibration(counts)
    dealt = _deal(shuffled, counts)
    if test.size:
        dealt["test"] = test
    return {
        role: np.flatnonzero(np.isin(dataset.sequence, dealt[role])).astype(np.int64)
        for role in shares
    }


def _more_calibration(counts: Mapping[str, int]) -> dict[str, int]:
    """Move sequences from fit and val to cal, enough for the rules that count them."""
    changed = dict(counts)
    for _ in range(2 * _CALIBRATION_SEQUENCES):
        donor = max(("val", "fit"), key=lambda role: changed[role])
        if changed["cal"] >= _CALIBRATION_SEQUENCES or changed[donor] <= 1:
            break
        changed[donor] -= 1
        changed["cal"] += 1
    return changed
