"""TUM trajectories (Sturm et al. 2012): ``timestamp tx ty tz qx qy qz qw`` in each line.

Seconds, metres and a quaternion, scalar last: ``T_world_camera`` of an OpenCV camera. Training and
``--ground-truth`` read these files by the same rules:

===============================================  ================================================
found in the file                                what happens
===============================================  ================================================
byte-order mark, CR LF, blank lines              ignored
``#``, also after blanks                         a comment
rows in any order                                sorted by stamp
a stamp again, with the same pose or another     the first row counts; the others are counted
nan or inf in a pose                             the row has no valid pose, and is counted
a quaternion whose norm is more than 0.01 off 1  the row has no valid pose, and is counted
another number of columns, other text            refused, with the line; also names without ``#``
a stamp that cannot be in seconds                refused, with the line
===============================================  ================================================

A frame whose nearest row has no valid pose gets no pose, not that of another row.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cvo_edge.trajectories.poses import quaternion_poses
from cvo_edge.trajectories.tables import read_rows
from cvo_edge.trajectories.trajectory import Entry, Trajectory, trajectory_of

Array = NDArray[np.float64]

FORM = "timestamp tx ty tz qx qy qz qw"

# Frames match the nearest stamp within this bound, as in the TUM tools.
MAX_STAMP_DIFFERENCE_NS = 20_000_000


def read_tum(path: Path) -> Trajectory[int]:
    """Read a TUM file, by stamp.

    Raises SourceError if the file cannot be read, a line is malformed, or no pose is valid.
    """
    return read_tum_columns(path, FORM)[0]


def read_tum_columns(path: Path, form: str) -> tuple[Trajectory[int], Array]:
    """Read a file whose ``form`` has more columns than ``FORM``, and these columns (n, c).

    Raises as ``read_tum``.
    """
    rows = read_rows(path, form)
    stamps = [row.seconds() for row in rows]
    numbers = np.array([row.numbers(1) for row in rows]).reshape(-1, len(form.split()) - 1)
    poses, faults = quaternion_poses(numbers[:, :3], numbers[:, 3:7])
    order = sorted(range(len(rows)), key=stamps.__getitem__)
    entries = [Entry(stamps[k], poses[k], rows[k].where, faults[k] or None) for k in order]
    # Of rows with one stamp, the first counts, as in ``trajectory_of``.
    first = {stamps[k]: k for k in reversed(order)}
    trajectory = trajectory_of(path, entries)
    return trajectory, numbers[[first[key] for key in trajectory.keys], 7:]
