"""What a scene's folder holds: its recordings, and the stages done with which options.

Every stage writes its result whole. The same command skips stages that are done and continues the
one that was interrupted; other options repeat their stage and all later ones.
"""

from __future__ import annotations

import hashlib
import shutil
import sys
from contextlib import suppress
from pathlib import Path
from typing import Literal, NamedTuple, get_args

import msgspec
from msgspec import Struct

from cvo_edge.errors import SinkError, UsageError
from cvo_export.files import read_json, write_json
from cvo_export.reconstruct.recordings import Recording

StageName = Literal["frames", "features", "matching", "mapping"]
STAGES: tuple[StageName, ...] = get_args(StageName)


class Layout(NamedTuple):
    """Files of a scene: the COLMAP data set, the report, and ``work`` for what continues it."""

    scene: Path

    @property
    def images(self) -> Path:
        """``images/VIDEO/frame-NNNNNN.jpg``."""
        return self.scene / "images"

    @property
    def sparse(self) -> Path:
        """COLMAP's binary model."""
        return self.scene / "sparse" / "0"

    @property
    def work(self) -> Path:
        """Everything that only a continued reconstruction reads."""
        return self.scene / "work"

    @property
    def frames(self) -> Path:
        """The frames used, with their origin."""
        return self.scene / "frames.json"

    @property
    def database(self) -> Path:
        """COLMAP's database of keypoints and matches."""
        return self.work / "database.db"

    @property
    def model(self) -> Path:
        """The map before it is scaled."""
        return self.work / "model"

    @property
    def outputs(self) -> dict[StageName, tuple[Path, ...]]:
        """What each stage writes."""
        database = [self.work / f"database.db{end}" for end in ("", "-wal", "-shm", "-journal")]
        return {
            "frames": (self.frames,),
            "features": tuple(database),
            "matching": (),
            "mapping": (self.model, self.work / "mapping.json", self.sparse),
        }


class _Stage(Struct):
    options: str
    done: bool


class _State(Struct):
    recordings: list[Recording]
    stages: dict[str, _Stage] = {}


class Stages:
    """The stages of a scene and the options they were done with; ``new`` if it began just now."""

    def __init__(self, layout: Layout, recordings: list[Recording]) -> None:
        """Open a new or an interrupted scene.

        Raises UsageError if the folder holds something else, or other recordings.
        """
        self._layout = layout
        self._file = layout.work / "state.json"
        self._before = ""
        self.new = not self._file.exists()
        if not self.new:
            self._state = read_json(self._file, _State, "the state of a reconstruction")
            _check_same(layout.scene, self._state.recordings, recordings)
            return
        if layout.scene.exists() and (not layout.scene.is_dir() or any(layout.scene.iterdir())):
            raise UsageError(
                f"{layout.scene}: expected a new folder, or one that reconstruct has begun, "
                "found something else; choose another folder"
            )
        self._state = _State(recordings)
        write_json(self._file, self._state)

    def begin(self, stage: StageName, options: object) -> bool:
        """Begin a stage, or return False if it is done with these options.

        What was done with other options is removed, with all later stages; so is what they began.
        Stages must begin in order.
        """
        content = self._before.encode() + msgspec.json.encode([stage, options])
        self._before = hashlib.sha256(content).hexdigest()
        found = self._state.stages.get(stage)
        if found is not None and found.options != self._before:
            later = STAGES[STAGES.index(stage) :]
            again = [name for name in later if name in self._state.stages]
            print(
                f"{self._layout.scene}: {', '.join(again)} was done with other options; "
                "doing it again",
                file=sys.stderr,
            )
            self._forget(later)
            found = None
        if found is not None and found.done:
            return False
        self._state.stages[stage] = _Stage(self._before, done=False)
        write_json(self._file, self._state)
        return True

    def end(self, stage: StageName) -> None:
        """Note that a stage is done."""
        self._state.stages[stage].done = True
        write_json(self._file, self._state)

    def done(self, stage: StageName) -> bool:
        """Whether a stage is done, with whatever options."""
        return (found := self._state.stages.get(stage)) is not None and found.done

    def repeat(self, stage: StageName) -> None:
        """Forget a stage and all later ones, so that they begin again."""
        self._forget(STAGES[STAGES.index(stage) :])

    def remove(self) -> None:
        """Remove what was noted, and the scene's folder if nothing else is in it."""
        remove(self._layout.work)
        with suppress(OSError):
            self._layout.scene.rmdir()

    def _forget(self, stages: tuple[StageName, ...]) -> None:
        for name in stages:
            self._state.stages.pop(name, None)
        # Noted before anything is removed: an interrupted removal leaves no stage that seems done.
        write_json(self._file, self._state)
        for name in stages:
            for path in self._layout.outputs[name]:
                remove(path)


def remove(path: Path) -> None:
    """Remove a file or a folder, if it exists; raises SinkError."""
    try:
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)
    except OSError as error:
        raise SinkError(f"{path}: cannot be removed: {error.strerror}") from None


def _check_same(scene: Path, before: list[Recording], now: list[Recording]) -> None:
    then = {each.name: each.identity for each in before}
    if then == {each.name: each.identity for each in now}:
        return
    changed = [each.path for each in now if then.get(each.name) not in (None, each.identity)]
    if changed:
        raise UsageError(f"{changed[0]}: has changed since {scene} was begun; choose a new folder")
    raise UsageError(
        f"{scene}: expected the recordings {', '.join(then)} that it was begun with, found "
        f"{', '.join(each.name for each in now)}; choose a new folder"
    )
