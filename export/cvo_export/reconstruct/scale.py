"""The metric scale of a map: from tags of known size, a known distance, or known poses."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from cvo_edge import geometry
from cvo_edge.errors import SourceError, UsageError
from cvo_edge.trajectories.poses import quaternion_pose
from cvo_export.reconstruct.model import Model
from cvo_export.reconstruct.recordings import frame_of, image_name
from cvo_export.reconstruct.similarity import Similarity, between_poses
from cvo_export.reconstruct.tags import Tag

Array = NDArray[np.float64]

Origin = Literal["tags", "distance", "poses", "none"]
_FEWEST_POSES = 2


class Scale(Struct, frozen=True):
    """Metres for a unit of the map, and where they come from.

    ``spread`` is half the range of the factors that single tags (or a single tag's edges, or pairs
    of known poses) give, relative to ``factor``; None if one number alone gives the scale.
    """

    origin: Origin
    factor: float = 1.0
    spread: float | None = None
    tags: tuple[Tag, ...] = ()


def scale_of_tags(tags: Sequence[Tag], size_m: float) -> Scale:
    """Return the median of the tags' scales; raises SourceError if there are no tags."""
    if not tags:
        raise SourceError(
            "tag size: expected a tag of the family 36h11 in two or more placed images from "
            "different sides, found none; show it longer and larger, or use --distance"
        )
    factors = [size_m / tag.edge for tag in tags]
    single = [size_m / edge for edge in tags[0].edges]
    factor = float(np.median(factors))
    spread = float(np.ptp(factors if len(tags) > 1 else single)) / (2 * factor)
    return Scale("tags", factor, spread, tuple(tags))


def scale_of_distance(model: Model, one: str, two: str, metres: float) -> Scale:
    """Return the scale by which two images are ``metres`` apart.

    Raises SourceError if one of them has not been placed, UsageError if they are the same place.
    """
    ends = np.array([model.poses[placed_row(model, name), :3] for name in (one, two)])
    apart = float(np.linalg.norm(ends[1] - ends[0]))
    if apart <= 0.0:
        raise UsageError(f"distance: expected two different frames, found {one} and {two}")
    return Scale("distance", metres / apart)


def align_to_poses(model: Model, known: dict[str, Array]) -> tuple[Scale, Similarity]:
    """Return scale and similarity into the world of known poses (7,) by image name.

    Raises SourceError if one of the images has not been placed, UsageError if they lie in one
    place, which leaves the scale open.
    """
    rows = [placed_row(model, name) for name in known]
    source, target = model.poses[rows], np.array(list(known.values()))
    apart = np.linalg.norm(source[:, None, :3] - source[:, :3], axis=2)
    metres = np.linalg.norm(target[:, None, :3] - target[:, :3], axis=2)
    pairs = np.triu(metres > 1e-3, 1)
    if not (pairs & (apart > 0)).any():
        raise UsageError("known poses: expected two frames in different places, found one place")
    similarity = between_poses(source, target)
    factors = metres[pairs] / np.maximum(apart[pairs], 1e-12)
    spread = float(np.ptp(factors)) / (2 * similarity.scale) if len(factors) > 1 else None
    return Scale("poses", similarity.scale, spread), similarity


def first_camera_world(model: Model, factor: float) -> Similarity:
    """Return the similarity into the frame of the first placed camera, scaled by ``factor``."""
    inverse = geometry.quaternion_conjugate(model.poses[0, 3:])
    R = geometry.quaternion_to_matrix(inverse)
    return Similarity(factor, inverse, -factor * R @ model.poses[0, :3])


def placed_row(model: Model, name: str) -> int:
    """Return the row of ``VIDEO/frame-NNNNNN``; raises SourceError if it has not been placed."""
    row = model.row(image_name(*frame_of(name)))
    if row is None:
        raise SourceError(
            f"{name}: expected a frame that the map contains, but it has not been placed; choose "
            "one that overlaps others"
        )
    return row


def read_known_poses(path: Path) -> dict[str, Array]:
    """Read lines ``VIDEO/frame-NNNNNN tx ty tz qx qy qz qw`` (metres, ``T_world_camera``).

    Empty lines and lines that begin with # are skipped. Raises UsageError with file and line.
    """
    try:
        lines = path.read_text("utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"{path}: expected known poses; cannot be read: {error}") from None
    found: dict[str, Array] = {}
    for number, line in enumerate(lines, 1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        try:
            numbers = np.array([float(word) for word in words[1:]])
        except ValueError:
            numbers = np.empty(0)
        pose = quaternion_pose(numbers[:3], numbers[3:]) if numbers.shape == (7,) else None
        if pose is None:
            raise UsageError(
                f"{path}:{number}: expected VIDEO/frame-NNNNNN tx ty tz qx qy qz qw with a unit "
                f"quaternion, found {line.strip()}"
            )
        try:
            name = image_name(*frame_of(words[0]))
        except UsageError as error:
            raise UsageError(f"{path}:{number}: {error}") from None
        if name in found:
            raise UsageError(f"{path}:{number}: expected each frame once, found {words[0]} again")
        found[name] = pose
    if len(found) < _FEWEST_POSES:
        raise UsageError(f"{path}: expected the poses of two or more frames, found {len(found)}")
    return found
