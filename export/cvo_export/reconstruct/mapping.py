"""Features, matches and the map by COLMAP, in a process of its own.

COLMAP ends its process on some errors and answers no signal; a process of its own can be ended at
any time, and what the stages have written so far stays.
"""

from __future__ import annotations

import multiprocessing
import os
import re
import shutil
import signal
import threading
from collections.abc import Callable, Mapping, Sequence
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Literal

import msgspec
from msgspec import Struct

from cvo_edge.camera import Camera
from cvo_edge.engine.cores import allowed_cores
from cvo_edge.errors import CvoError, SinkError, SourceError
from cvo_edge.process import signals_deferred
from cvo_export.files import write_json
from cvo_export.progress import Progress, Stage
from cvo_export.reconstruct.model import colmap_camera
from cvo_export.reconstruct.pairs import image_pairs
from cvo_export.reconstruct.stages import Layout, remove

Mapper = Literal["global", "incremental"]

FEATURES = 2048
# Images or pairs between two reports, and so between two points where COLMAP can be ended.
_IMAGES, _PAIRS = 8, 64
# A map with a smaller share of the images is compared with the other mapper's.
GOOD_SHARE = 0.95
_SECONDS_TO_LEAVE = 5.0
_DISK_FULL = re.compile("disk is full|No space left|disk I/O error|File too large", re.IGNORECASE)


class Mapped(Struct, frozen=True):
    """The mapper that was kept, and the images that each mapper tried has placed."""

    mapper: Mapper
    images: dict[str, int]
    other_worlds: list[int]


class Group(Struct, frozen=True):
    """Images of one camera; ``camera`` is None if its intrinsics are to be estimated."""

    names: tuple[str, ...]
    camera: Camera | None


def extract(layout: Layout, groups: Sequence[Group], progress: Progress) -> None:
    """Find the keypoints of images; those in the database are kept."""
    import pycolmap

    total = sum(len(group.names) for group in groups)
    done = 0
    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu, options.num_threads = False, allowed_cores()
    options.sift.max_num_features = FEATURES
    for group in groups:
        reader = pycolmap.ImageReaderOptions()
        reader.camera_model = "SIMPLE_RADIAL"
        if group.camera is not None:
            reader.camera_model, parameters = colmap_camera(group.camera)
            reader.camera_params = ",".join(map(repr, parameters))
        for first in range(0, len(group.names), _IMAGES):
            names = list(group.names[first : first + _IMAGES])
            reader.existing_camera_id = _camera_of(layout.database, group.names[0])
            pycolmap.extract_features(
                layout.database,
                layout.images,
                image_names=names,
                camera_mode=pycolmap.CameraMode.SINGLE,
                reader_options=reader,
                extraction_options=options,
            )
            done += len(names)
            progress("features", done, total)


def _camera_of(database: Path, name: str) -> int:
    """Return the number of an image's camera, -1 if the database does not know the image."""
    import pycolmap

    if not database.exists():
        return -1
    with pycolmap.Database.open(database) as opened:
        image = opened.read_image_with_name(name)
        return -1 if image is None else int(image.camera_id)


def match(layout: Layout, names: Sequence[str], progress: Progress) -> None:
    """Match the images' keypoints and verify the matches; matched pairs are kept."""
    import pycolmap

    with pycolmap.Database.open(layout.database) as database:
        known = {image.name: image.image_id for image in database.read_all_images()}
        descriptors = [database.read_descriptors(known[name]).data for name in names]
    pairs = image_pairs(names, descriptors)
    options = pycolmap.FeatureMatchingOptions()
    options.use_gpu, options.num_threads = False, allowed_cores()
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = 0
    listed = pycolmap.ImportedPairingOptions()
    listed.match_list_path = layout.work / "pairs.txt"
    for first in range(0, len(pairs), _PAIRS):
        chunk = pairs[first : first + _PAIRS]
        lines = [f"{names[i]} {names[j]}\n" for i, j in chunk]
        Path(listed.match_list_path).write_text("".join(lines), "utf-8")
        pycolmap.match_image_pairs(layout.database, options, listed, verification)
        progress("matching", first + len(chunk), len(pairs))


def build(
    layout: Layout, count: int, known: bool, mappers: Sequence[Mapper], progress: Progress
) -> None:
    """Build the map of ``count`` images with the first mapper that places nearly all of them.

    ``known``: intrinsics are given and stay. Raises SourceError if no mapper finds a map.
    """
    import pycolmap

    tried: dict[Mapper, list[Any]] = {}
    if not known and not pycolmap.calibrate_view_graph(layout.database, _calibration()):
        mappers = [*mappers, "incremental"]
    for number, mapper in enumerate(dict.fromkeys(mappers)):
        progress("mapping", number, len(mappers), mapper)
        folder = layout.work / f"trial-{mapper}"
        remove(folder)
        folder.mkdir()
        found = _mapped(mapper, layout, folder, known)
        tried[mapper] = sorted(found.values(), key=lambda each: -each.num_reg_images())
        if found and tried[mapper][0].num_reg_images() >= GOOD_SHARE * count:
            break
    placed: dict[str, int] = {
        mapper: each[0].num_reg_images() if each else 0 for mapper, each in tried.items()
    }
    best = max(tried, key=lambda mapper: placed[mapper])
    if not placed[best]:
        raise SourceError(
            f"{layout.scene}: expected images that overlap and a camera that moves sideways, found "
            f"no two of {count} images that give a map; record slower, with more texture in view"
        )
    partial = layout.work / "model.partial"
    remove(partial)
    partial.mkdir()
    tried[best][0].write_binary(partial)
    remove(layout.model)
    partial.rename(layout.model)
    others = [each.num_reg_images() for each in tried[best][1:]]
    write_json(layout.work / "mapping.json", Mapped(best, placed, others))
    for mapper in tried:
        remove(layout.work / f"trial-{mapper}")
    progress("mapping", len(mappers), len(mappers), best)


def _calibration() -> Any:  # noqa: ANN401 - pycolmap is imported where it runs
    import pycolmap

    options = pycolmap.ViewGraphCalibrationOptions()
    options.random_seed = 0
    return options


def _mapped(mapper: Mapper, layout: Layout, folder: Path, known: bool) -> Mapping[int, Any]:
    import pycolmap

    threads = allowed_cores()
    if mapper == "global":
        options = pycolmap.GlobalPipelineOptions()
        options.num_threads, options.random_seed = threads, 0
        adjustment = options.mapper.bundle_adjustment
        adjustment.refine_focal_length = adjustment.refine_extra_params = not known
        found = pycolmap.global_mapping(layout.database, layout.images, folder, options)
    else:
        steps = pycolmap.IncrementalPipelineOptions()
        steps.num_threads, steps.random_seed = threads, 0
        steps.ba_refine_focal_length = steps.ba_refine_extra_params = not known
        steps.min_model_size = 3
        found = pycolmap.incremental_mapping(layout.database, layout.images, folder, steps)
    return dict(found)


# ------------------------------------------------------------------------------------- process


def in_process(layout: Layout, task: Callable[[Progress], None], progress: Progress) -> None:
    """Run a picklable task in another process, and report its progress here.

    Raises the task's error; SinkError if the disk is full; SourceError if the process died.
    """
    log = layout.work / "log.txt"
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_child, args=(sender, task, log), daemon=True)
    try:
        with signals_deferred():
            process.start()
        # Only the process holds the sending end now, so that its death closes the pipe.
        sender.close()
        while True:
            try:
                message = receiver.recv()
            except EOFError:
                process.join()
                raise _death(layout, process.exitcode, log) from None
            if isinstance(message, CvoError):
                raise message
            if message is None:
                break
            progress(*message)
        process.join()
    finally:
        if process.is_alive():
            process.terminate()
            process.join(_SECONDS_TO_LEAVE)
            process.kill()
        receiver.close()


def _child(sender: Connection, task: Callable[[Progress], None], log: Path) -> None:
    # The parent ends this process; COLMAP writes its messages to the log.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    descriptor = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644)
    os.dup2(descriptor, 2)
    import pycolmap

    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.WARNING)

    def progress(stage: Stage, done: int, total: int, note: str = "") -> None:
        sender.send((stage, done, total, note))

    try:
        task(progress)
    except CvoError as error:
        sender.send(error)
    except OSError as error:
        sender.send(SinkError(f"{error.filename or log.parent}: {error.strerror}"))
    except Exception as error:  # noqa: BLE001 - COLMAP raises what C++ raises
        os.write(2, f"{type(error).__name__}: {error}\n".encode())
        os._exit(1)
    else:
        sender.send(None)


def _end_with_parent() -> None:
    # A parent that was killed cannot end this process, and the same command starts another one.
    if (parent := multiprocessing.parent_process()) is not None:
        parent.join()
        os._exit(1)


def _death(layout: Layout, code: int | None, log: Path) -> CvoError:
    try:
        text = log.read_text("utf-8", "replace").strip()
    except OSError:
        text = ""
    if _DISK_FULL.search(text) or shutil.disk_usage(layout.scene).free < 1 << 20:
        return SinkError(
            f"{layout.database}: cannot be written: the disk is full; free some space and repeat "
            "the command, which continues"
        )
    last = text.splitlines()[-1] if text else "no message"
    return SourceError(
        f"{layout.scene}: COLMAP ended with exit code {code}: {last}; repeat the command, or see "
        f"{log}"
    )


def read_mapped(layout: Layout) -> Mapped:
    """Return what ``build`` noted."""
    return msgspec.json.decode((layout.work / "mapping.json").read_bytes(), type=Mapped)
