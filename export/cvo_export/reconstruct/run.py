"""Reconstruct a scene from recordings: all stages, the scale and the report."""

from __future__ import annotations

import sqlite3
from collections.abc import Sequence
from contextlib import closing
from functools import partial
from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from cvo_edge.errors import SourceError, UsageError
from cvo_export.files import write_json
from cvo_export.progress import Progress
from cvo_export.reconstruct.choice import chosen, fitting_step
from cvo_export.reconstruct.mapping import (
    FEATURES,
    Group,
    Mapped,
    Mapper,
    build,
    extract,
    in_process,
    match,
    read_mapped,
)
from cvo_export.reconstruct.model import Model, read_intrinsics, read_model, write_transformed
from cvo_export.reconstruct.recordings import (
    Motion,
    Recording,
    find_recordings,
    frame_of,
    image_name,
    measure,
    write_images,
)
from cvo_export.reconstruct.report import Report, make_report
from cvo_export.reconstruct.scale import (
    Scale,
    align_to_poses,
    first_camera_world,
    read_known_poses,
    scale_of_distance,
    scale_of_tags,
)
from cvo_export.reconstruct.stages import Layout, Stages
from cvo_export.reconstruct.tags import Sighting, find_tags, locate_tags

Array = NDArray[np.float64]
Distance = tuple[str, str, float]

# Global mapping placed as many images as incremental mapping and was as exact; see DECISIONS.md.
MAPPERS: tuple[Mapper, ...] = ("global", "incremental")


class Options(Struct, frozen=True, kw_only=True):
    """Options of ``reconstruct``; at most one of the last three.

    ``step`` is the motion between frames that are used, in image widths, ``most`` the largest
    number of them, ``intrinsics`` as for ``read_intrinsics``, ``distance`` two frames and metres.
    ``mappers`` are tried in turn until one places nearly all images.
    """

    step: float = 0.04
    most: int = 300
    intrinsics: str | None = None
    tag_size_m: float | None = None
    distance: Distance | None = None
    known_poses: Path | None = None
    mappers: tuple[Mapper, ...] = MAPPERS


class Used(Struct, frozen=True):
    """A frame that is used: its image's name, and where it comes from."""

    name: str
    source: str
    stamp_ns: int | None
    width: int
    height: int


def reconstruct(paths: Sequence[str], scene: Path, options: Options, progress: Progress) -> Report:
    """Reconstruct the recordings of one place; repeat the call to continue an interrupted one.

    ``scene`` becomes a COLMAP data set: ``images/VIDEO/frame-NNNNNN.jpg`` and the binary model
    ``sparse/0``, whose world frame is the first camera's, or that of known poses. ``frames.json``
    lists the origin of the images, ``report.json`` the figures.

    Raises
    ------
    UsageError
        pycolmap is missing, or an option is invalid, or the folder holds another reconstruction.
    SourceError
        A recording cannot be read, or the images give no map or no scale.
    SinkError
        A file cannot be written, e.g. because the disk is full; the same call continues.
    """
    known, asked = _checked(options)
    layout = Layout(scene)
    recordings = find_recordings(paths)
    _check_names(asked, recordings)
    stages = Stages(layout, recordings)
    try:
        motions = {
            each.name: measure(each, layout.work / f"motion-{each.name}.json", progress)
            for each in recordings
        }
        used = choose(motions, options.step, options.most, asked)
        groups = _groups(motions, used, options.intrinsics)
    except (SourceError, UsageError):
        # Nothing is worth continuing.
        if stages.new:
            stages.remove()
        raise
    if stages.begin("frames", used):
        _write_frames(layout, recordings, used, progress)
        stages.end("frames")
    names = [each.name for each in used]
    _check_database(layout, stages)
    if stages.begin("features", (groups, FEATURES)):
        in_process(layout, partial(extract, layout, groups), progress)
        stages.end("features")
    if stages.begin("matching", None):
        in_process(layout, partial(match, layout, names), progress)
        stages.end("matching")
    given = options.intrinsics is not None
    if stages.begin("mapping", options.mappers):
        task = partial(build, layout, len(names), given, options.mappers)
        in_process(layout, task, progress)
        stages.end("mapping")
    found, mapped = _read_map(layout, stages)
    scale, model = _scaled(layout, found, options, known, progress)
    lengths = {name: len(motion.sources) for name, motion in motions.items()}
    report = make_report(lengths, names, model, mapped, scale, intrinsics_known=given)
    write_json(scene / "report.json", report)
    return report


def _checked(options: Options) -> tuple[dict[str, Array] | None, list[str]]:
    """Check the options; returns the known poses and the frames that the options name."""
    if find_spec("pycolmap") is None:
        raise UsageError(
            'reconstruct: pycolmap is not installed; pip install "cvo-export[reconstruct]"'
        )
    if not 0.0 < options.step <= 1.0:
        raise UsageError(f"step: expected up to 1 image width, found {options.step:g}")
    if options.most < 2:
        raise UsageError(f"frames: expected two or more, found {options.most}")
    given = {
        "--tag-size": options.tag_size_m,
        "--distance": options.distance,
        "--known-poses": options.known_poses,
    }
    several = [name for name, value in given.items() if value is not None]
    if len(several) > 1:
        raise UsageError(f"scale: expected one source, found {' and '.join(several)}")
    if options.tag_size_m is not None and not 0.0 < options.tag_size_m < np.inf:
        raise UsageError(f"tag size: expected metres above 0, found {options.tag_size_m:g}")
    if options.distance is not None:
        one, two, metres = options.distance
        if frame_of(one) == frame_of(two) or not 0.0 < metres < np.inf:
            raise UsageError(
                "distance: expected two different frames and metres above 0, found "
                f"{one} {two} {metres:g}"
            )
        return None, [one, two]
    if options.known_poses is not None:
        known = read_known_poses(options.known_poses)
        return known, list(known)
    return None, []


def _check_names(asked: Sequence[str], recordings: Sequence[Recording]) -> None:
    names = {each.name for each in recordings}
    for frame in asked:
        if frame_of(frame)[0] not in names:
            raise UsageError(
                f"{frame}: expected a frame of {', '.join(sorted(names))}, found another recording"
            )


def _write_frames(
    layout: Layout, recordings: Sequence[Recording], used: Sequence[Used], progress: Progress
) -> None:
    found = [frame_of(each.name) for each in used]
    for each in recordings:
        numbers = [number for name, number in found if name == each.name]
        write_images(each, numbers, layout.images, progress)
    write_json(layout.frames, used)


def choose(motions: dict[str, Motion], step: float, most: int, asked: Sequence[str]) -> list[Used]:
    """Return the frames to use, by recording and time: see ``choice``, and those asked for.

    Raises UsageError if a frame that is asked for does not exist or cannot be read, SourceError if
    fewer than two frames are left.
    """
    readable = {name: motion.readable for name, motion in motions.items()}
    measured = {
        name: (
            [motion.motions[n] for n in readable[name]],
            [motion.sharpnesses[n] for n in readable[name]],
        )
        for name, motion in motions.items()
    }
    step = fitting_step(list(measured.values()), step, most)
    numbers = {
        name: {readable[name][row] for row in chosen(*measured[name], step)} for name in motions
    }
    for frame in asked:
        name, number = frame_of(frame)
        if number not in readable[name]:
            last = len(motions[name].sources) - 1
            raise UsageError(f"{frame}: expected a readable frame of 0 to {last}, found none")
        numbers[name].add(number)
    if sum(map(len, numbers.values())) < 2:
        frames = sum(map(len, readable.values()))
        raise SourceError(
            f"{', '.join(motions)}: expected two or more frames {step:g} image widths of motion "
            f"apart (--step), found 1 of {frames}; record a camera that moves"
        )
    return [
        Used(
            image_name(name, number),
            motion.sources[number],
            motion.stamps_ns[number],
            motion.width,
            motion.height,
        )
        for name, motion in motions.items()
        for number in sorted(numbers[name])
    ]


def _groups(
    motions: dict[str, Motion], used: Sequence[Used], intrinsics: str | None
) -> list[Group]:
    """Return the images by size: one camera for each size."""
    sizes = list(dict.fromkeys((each.width, each.height) for each in motions.values()))
    if intrinsics is not None and len(sizes) > 1:
        found = " and ".join(f"{width}x{height}" for width, height in sizes)
        raise SourceError(
            f"intrinsics: expected recordings of one image size, found {found}; reconstruct "
            "without --intrinsics"
        )
    return [
        Group(
            tuple(each.name for each in used if (each.width, each.height) == size),
            None if intrinsics is None else read_intrinsics(intrinsics, *size),
        )
        for size in sizes
    ]


def _check_database(layout: Layout, stages: Stages) -> None:
    """Raise SourceError if the database is missing or damaged; the same call then makes it anew."""
    if not stages.done("features"):
        return
    damaged = not layout.database.exists()
    if not damaged:
        try:
            with closing(sqlite3.connect(layout.database)) as opened:
                opened.execute("SELECT count(*) FROM images").fetchone()
        except sqlite3.OperationalError:
            # Locked, or the disk is full: COLMAP will say so.
            return
        except sqlite3.DatabaseError:
            damaged = True
    if damaged:
        stages.repeat("features")
        raise SourceError(_damaged(layout.database, "the keypoints"))


def _read_map(layout: Layout, stages: Stages) -> tuple[Model, Mapped]:
    """Return the finished map; raises SourceError if damaged, and the same call maps again."""
    try:
        return read_model(layout.model), read_mapped(layout)
    except (OSError, ValueError, LookupError, RuntimeError, SourceError):
        stages.repeat("mapping")
        raise SourceError(_damaged(layout.model, "the map")) from None


def _damaged(path: Path, what: str) -> str:
    return (
        f"{path}: expected {what}, found damaged files; repeat the command, which makes them anew"
    )


def _scaled(
    layout: Layout,
    model: Model,
    options: Options,
    known: dict[str, Array] | None,
    progress: Progress,
) -> tuple[Scale, Model]:
    """Write the map in its final world frame; returns the scale and the map."""
    if known is not None:
        scale, similarity = align_to_poses(model, known)
    else:
        scale = Scale("none")
        if options.tag_size_m is not None:
            tags = locate_tags(model, _sightings(layout, model, progress))
            scale = scale_of_tags(tags, options.tag_size_m)
        elif options.distance is not None:
            scale = scale_of_distance(model, *options.distance)
        similarity = first_camera_world(model, scale.factor)
    return scale, write_transformed(layout.model, layout.sparse, similarity)


def _sightings(layout: Layout, model: Model, progress: Progress) -> list[Sighting]:
    found = []
    for row, name in enumerate(model.names):
        image = cv2.imread(str(layout.images / name))
        if image is None:
            raise SourceError(f"{layout.images / name}: expected an image; choose a new folder")
        found += [Sighting(number, row, corners) for number, corners in find_tags(image)]
        progress("tags", row + 1, len(model.names))
    return found
