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

from cvo_edge.trajectories.poses import quaternion_fault, quaternion_pose
from cvo_edge.trajectories.tables import read_rows
from cvo_edge.trajectories.trajectory import Entry, Trajectory, trajectory_of

FORM = "timestamp tx ty tz qx qy qz qw"

# Frames match the nearest stamp within this bound, as in the TUM tools.
MAX_STAMP_DIFFERENCE_NS = 20_000_000


def read_tum(path: Path) -> Trajectory[int]:
    """Read a TUM file, by stamp.

    Raises SourceError if the file cannot be read, a line is malformed, or no pose is valid.
    """
    entries = []
    for row in read_rows(path, FORM):
        numbers = row.numbers(1)
        position_m, q_xyzw = numbers[:3], numbers[3:]
        fault = quaternion_fault(position_m, q_xyzw)
        pose = quaternion_pose(position_m, q_xyzw)
        entries.append(Entry(row.seconds(), pose, row.where, fault))
    return trajectory_of(path, sorted(entries, key=lambda entry: entry.key))
