"""Draw the trajectory of a data set: from above, from the side, and each degree of freedom."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cvo_edge import geometry
from cvo_edge.errors import UsageError
from cvo_edge.files import picture_metadata
from cvo_export.datasets.base import PoseDataset
from cvo_export.datasets.motion import Motion, motion_of, up_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Array = NDArray[np.float64]

SUFFIXES = (".png", ".svg", ".pdf")
_DPI = 130
# Colours that colour-blind readers can tell apart (Okabe and Ito 2008).
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
_ROLES = {
    "train": "#0072B2",
    "fit": "#56B4E9",
    "val": "#F0E442",
    "cal": "#009E73",
    "test": "#D55E00",
}
# More recordings than these are not named in a legend.
_NAMED = 12
# Directions of view that are drawn.
_VIEWS = 40
# Cosine of the angle within which up is taken for an axis of the world.
_ALONG = 0.966
_LABELS = ("tx (m)", "ty (m)", "tz (m)", "rx (deg)", "ry (deg)", "rz (deg)")


def check_picture(path: Path, option: str) -> None:
    """Raise UsageError unless matplotlib is installed and the name is that of a picture."""
    try:
        import matplotlib as _  # noqa: F401
    except ImportError:
        raise UsageError(
            f'{option}: matplotlib is not installed; pip install "cvo-export[plot]"'
        ) from None
    if path.suffix.lower() not in SUFFIXES or path.is_dir():
        raise UsageError(
            f"{option}: expected a file name ending in {', '.join(SUFFIXES)}, found {path}"
        )


def draw(
    dataset: PoseDataset,
    stream: BinaryIO,
    suffix: str,
    roles: Mapping[str, NDArray[np.int64]] | None = None,
) -> None:
    """Write a picture of a data set's poses to a stream, in the format of a file's ``suffix``.

    From above and from the side, metres with equal scales, with the direction of view of some
    frames; and each degree of freedom over time or frames, rotations as vectors about the mean
    rotation. Recordings have a colour each; jumps and gaps are marked, and ``roles`` are shown.
    """
    from matplotlib.figure import Figure

    motion, up = motion_of(dataset), up_of(dataset.poses)
    figure = Figure(figsize=(15, 10), layout="constrained")
    left, right = figure.subfigures(1, 2, squeeze=False, width_ratios=(1.0, 1.2))[0]
    views = left.subplots(2, 1, height_ratios=(2.0, 1.0))
    above, side = _axes_of(dataset.poses, up.direction)
    _draw_view(views[0], dataset, motion, above, "from above")
    _draw_view(views[1], dataset, motion, side, "from the side")
    panels = right.subplots(6, 1, sharex=True)
    _draw_dof(panels, dataset, motion, roles or {})
    right.align_ylabels(panels)
    figure.suptitle(
        f"{dataset.name}: {len(dataset)} frames, path {motion.metres.sum():.1f} m"
        + (f"; up is not sure: {up.doubt}" if up.doubt else "")
    )
    figure.savefig(stream, format=suffix[1:].lower(), dpi=_DPI, metadata=picture_metadata(suffix))


class _Direction(NamedTuple):
    """A direction (3,) in the world that a picture shows, and its label."""

    vector: Array
    label: str


def _axes_of(poses: Array, up: Array) -> tuple[list[_Direction], list[_Direction]]:
    """Return right and upper direction of the views from above and from the side.

    They are axes of the world, so that the picture shows the file's numbers, if up is close to one.
    """
    nearest = int(np.abs(up).argmax())
    if np.abs(up[nearest]) >= _ALONG:
        sign = 1 if up[nearest] > 0.0 else -1
        first, second = ((nearest + sign * turn) % 3 for turn in (1, 2))
        named = [_Direction(np.eye(3)[axis], f"{'xyz'[axis]} (m)") for axis in (first, second)]
        vertical = _Direction(sign * np.eye(3)[nearest], f"{'- '[sign > 0]}{'xyz'[nearest]} (m)")
    else:
        level = poses[:, :3] - poses[:, :3].mean(axis=0)
        level -= np.outer(level @ up, up)
        # The direction of the widest motion, among those that are level.
        _, vectors = np.linalg.eigh(level.T @ level - len(poses) * np.outer(up, up))
        longest = vectors[:, -1]
        named = [
            _Direction(longest, "level, along the widest motion (m)"),
            _Direction(np.cross(up, longest), "level, across (m)"),
        ]
        vertical = _Direction(up, "up (m)")
    widest = max(named, key=lambda each: float(np.ptp(poses[:, :3] @ each.vector)))
    return named, [widest, vertical]


def _draw_view(
    axes: Axes, dataset: PoseDataset, motion: Motion, directions: list[_Direction], title: str
) -> None:
    vectors = np.stack([each.vector for each in directions])
    position = dataset.local_poses[:, :3] @ vectors.T
    forward = geometry.quaternion_to_matrix(dataset.poses[:, 3:])[..., 2] @ vectors.T
    reach = 0.06 * max(float(np.ptp(position, axis=0).max()), 1e-3)
    for number, rows in _recordings(dataset):
        colour = _COLOURS[number % len(_COLOURS)]
        broken = _broken(position[rows], motion.jumps[np.isin(motion.first, rows[:-1])])
        axes.plot(*broken.T, "-", color=colour, linewidth=1.2, label=dataset.sequence_names[number])
        axes.plot(*position[rows[0]], "o", color=colour, markersize=5)
    shown = np.arange(0, len(dataset), max(1, len(dataset) // _VIEWS))
    axes.quiver(
        *position[shown].T,
        *(reach * forward[shown]).T,
        angles="xy",
        scale_units="xy",
        scale=1.0,
        width=0.002,
        color=[_COLOURS[number % len(_COLOURS)] for number in dataset.sequence[shown]],
        alpha=0.6,
    )
    _mark(axes, position[motion.first[motion.jumps]], "x", "#000000", "jump")
    _mark(axes, position[motion.first[motion.gaps]], "s", "#999999", "gap")
    far = "" if dataset.origin_m is None else ", about the origin"
    axes.set_xlabel(directions[0].label + far)
    axes.set_ylabel(directions[1].label)
    axes.set_aspect("equal", "datalim")
    axes.grid(color="#DDDDDD", linewidth=0.6)
    axes.set_title(f"{title}; circle: start, arrow: direction of view", fontsize=10)
    if title == "from above" and (
        motion.jumps.any() or motion.gaps.any() or 1 < len(dataset.sequence_names) <= _NAMED
    ):
        handles, labels = axes.get_legend_handles_labels()
        few = slice(None if len(dataset.sequence_names) <= _NAMED else 0)
        axes.legend(handles[few], labels[few], loc="best", fontsize=8)


def _draw_dof(
    panels: list[Axes],
    dataset: PoseDataset,
    motion: Motion,
    roles: Mapping[str, NDArray[np.int64]],
) -> None:
    reference = geometry.quaternion_conjugate(geometry.mean_rotation(dataset.poses[:, 3:]))
    turned = geometry.quaternion_multiply(reference, dataset.poses[:, 3:])
    rotation = np.rad2deg(geometry.quaternion_log(turned))
    values = np.concatenate([dataset.local_poses[:, :3], rotation], axis=1)
    timed = dataset.stamps_ns is not None and len(dataset.sequence_names) == 1
    time = np.arange(len(dataset), dtype=np.float64)
    if timed and dataset.stamps_ns is not None:
        time = (dataset.stamps_ns - dataset.stamps_ns[0]) / 1e9
    for dof, axes in enumerate(panels):
        for number, rows in _recordings(dataset):
            cut = motion.jumps[np.isin(motion.first, rows[:-1])]
            if dof > 2:
                # A rotation vector changes sides at half a turn.
                cut = cut | (
                    np.abs(np.diff(rotation[rows], axis=0)).max(axis=1, initial=0.0) > 180.0
                )
            line = _broken(np.column_stack([time[rows], values[rows, dof]]), cut)
            axes.plot(*line.T, "-", color=_COLOURS[number % len(_COLOURS)], linewidth=1.0)
        for step in np.flatnonzero(motion.gaps):
            axes.axvspan(time[motion.first[step]], time[motion.first[step] + 1], color="#CCCCCC")
        for step in np.flatnonzero(motion.jumps):
            axes.axvline(
                time[motion.first[step] + 1], color="#000000", linestyle=":", linewidth=1.0
            )
        _draw_roles(axes, roles, time)
        axes.set_ylabel(_LABELS[dof])
        axes.margins(x=0.01, y=0.12)
        axes.grid(color="#DDDDDD", linewidth=0.6)
    panels[-1].set_xlabel("seconds" if timed else "frame")
    text = "degrees of freedom; rotation about the mean rotation"
    panels[0].set_title(
        f"{text}{'; strip: roles of the default split' if roles else ''}", fontsize=10
    )
    if roles:
        panels[-1].legend(loc="upper right", bbox_to_anchor=(1.0, -0.3), ncols=5, fontsize=8)


def _draw_roles(axes: Axes, roles: Mapping[str, NDArray[np.int64]], time: Array) -> None:
    """Draw a strip that shows which frames have which role."""
    usual = float(np.median(np.diff(time))) if len(time) > 1 else 1.0
    for role, rows in roles.items():
        runs = np.split(rows, np.flatnonzero(np.diff(rows) != 1) + 1) if rows.size else []
        axes.broken_barh(
            [(time[run[0]], time[run[-1]] - time[run[0]] + usual) for run in runs],
            (0.0, 0.06),
            transform=axes.get_xaxis_transform(),
            color=_ROLES[role],
            linewidth=0,
            zorder=3,
            label=role,
        )


def _recordings(dataset: PoseDataset) -> list[tuple[int, NDArray[np.int64]]]:
    """Return number and frame numbers of each recording."""
    starts = np.flatnonzero(np.diff(dataset.sequence, prepend=-1))
    parts = np.split(np.arange(len(dataset)), starts[1:])
    return [(int(dataset.sequence[rows[0]]), rows) for rows in parts]


def _broken(points: Array, cut: NDArray[np.bool_]) -> Array:
    """Return points (n, 2) with NaN after those from which a step (n - 1,) is cut."""
    return np.insert(points, np.flatnonzero(cut) + 1, np.nan, axis=0)


def _mark(axes: Axes, points: Array, marker: str, colour: str, label: str) -> None:
    if len(points):
        axes.plot(*points.T, marker, color=colour, markersize=6, linewidth=0, label=label)
