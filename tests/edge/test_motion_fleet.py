"""``conformalize`` on many recordings: tasks of a cluster, groups, the report."""

import io
import pickle
import shlex
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest

from cvo_edge.errors import SourceError, UsageError
from cvo_edge.motion.conformalize import conformalize
from cvo_edge.motion.format import encode_motion_file
from cvo_edge.motion.horizons import Horizon
from cvo_edge.programs.motion_report import fit_lines
from cvo_edge.programs.progress import ItemsProgress
from cvo_edge.programs.trajectories import Files, Reading, fits, listed_files, read_pairs
from cvo_edge.spread import Here

from .simulated_drives import drive
from .test_motion_files import run, written

HORIZONS = tuple(map(Horizon.parse, ("1f", "1s", "5m")))
WINDOWS = (Horizon.parse("5s"),)


class Carried(Here):
    """Items that travel as bytes before and after each function, as between processes."""

    def map(self, function: Callable, *each: Sequence, what: str = "") -> "Carried":
        function, each = carried((function, each))
        return Carried(
            [carried(function(*arguments)) for arguments in zip(self, *each, strict=True)]
        )

    def take(self, places: Sequence[int]) -> "Carried":
        return Carried([self[place] for place in places])


def carried(value: object) -> object:
    """Return what comes out of the bytes of a value; arrays are read-only, as in shared memory."""
    buffers: list[pickle.PickleBuffer] = []
    content = pickle.dumps(value, protocol=5, buffer_callback=buffers.append)
    return pickle.loads(content, buffers=[bytes(each.raw()) for each in buffers])


@pytest.mark.parametrize("learned", [True, False])
def test_tasks_of_a_cluster_give_the_file_of_one_process(learned: bool) -> None:
    pairs = [drive(seed, noise=1.0 + seed % 3) for seed in range(5)]
    here, there = (
        encode_motion_file(conformalize(kind(pairs), "test", HORIZONS, WINDOWS, learned=learned))
        for kind in (Here, Carried)
    )
    assert here == there


def test_the_first_malformed_recording_is_named(tmp_path: Path) -> None:
    files = [Files(*written(drive(seed, 60), tmp_path)) for seed in range(4)]
    for place in (3, 1):
        files[place].estimate.write_text("1 2 3\n")
    for kind in (Here, Carried):
        with pytest.raises(SourceError, match=r"drive-1\.tum: .* 3 columns in line 1"):
            read_pairs(files, Reading(), kind)


def test_without_a_cluster_nothing_is_written(tmp_path: Path, monkeypatch) -> None:
    pytest.importorskip("ray")
    files = [path for seed in (1, 2) for path in written(drive(seed, 60), tmp_path)]
    monkeypatch.setenv("RAY_ADDRESS", "127.0.0.1:9")
    output = tmp_path / "motion.json"
    code, text = run("conformalize", *files, "-o", output, "--engine", "ray")
    assert (code, "conformalize: no Ray cluster at 127.0.0.1:9" in text) == (2, True), text
    monkeypatch.setitem(sys.modules, "ray", None)
    code, text = run("conformalize", *files, "-o", output, "--engine", "ray")
    assert (code, 'pip install "cvo-edge[ray]"' in text) == (2, True), text
    assert not output.exists()


def test_a_copy_of_a_truth_is_no_other_drive(tmp_path: Path) -> None:
    (one, truth), (other, _) = (written(drive(seed, 60), tmp_path) for seed in (1, 2))
    copy = tmp_path / "a copy.tum"
    copy.write_text(truth.read_text())
    third = written(drive(3, 60), tmp_path)
    listed = tmp_path / "pairs.txt"
    names = [(one, truth), (one, copy), third]
    listed.write_text("".join(f"{shlex.join(path.name for path in two)} # ok\n" for two in names))
    files = listed_files([], listed, [])
    pairs, notes = read_pairs(files, Reading())
    groups = [pair.group for pair in pairs.collect()]
    assert groups[0] == groups[1] != groups[2]
    assert len(notes) == 1
    assert notes[0].startswith("one drive: ")
    _, notes = read_pairs(listed_files([], listed, ["a", "b", "c"]), Reading())
    assert "but they count as drives a, b" in notes[0]
    listed.write_text("'a b.tum c.tum\n")
    with pytest.raises(SourceError, match="names with spaces in quotes"):
        listed_files([], listed, [])
    with pytest.raises(UsageError, match="expected one for each of 1"):
        listed_files([one, other], None, ["a", "b"])


def test_a_report_on_many_pairs_names_those_that_stand_out() -> None:
    fitted = fits(Here([drive(seed, 200) for seed in range(2)]))
    worth = fitted[1].effects["time"]
    late = fitted[1]._replace(name="late", effects={**fitted[1].effects})
    late.effects["time"] = worth._replace(after=0.5 * worth.before, worth=True)
    few = list(fit_lines([*fitted, late], []))
    many = list(fit_lines([fitted[0]] * 999 + [late], []))
    assert len(few) == 1 + 3 + 2
    assert many[0].startswith("1000 recordings")
    assert "1 of 1000 stand out; most of all:" in many
    assert sum(line.startswith("late") for line in many) == 1
    assert sum(line.startswith("drive") for line in many) == 0
    assert len(many) < 20


def test_progress_counts_each_kind_of_work_by_itself() -> None:
    times = iter(np.arange(0.0, 10.0, 0.5).tolist())
    terminal = io.StringIO()
    progress = ItemsProgress(terminal, lambda: next(times))
    for what in ("reading", "alignment"):
        for done in (1, 2, 4):
            progress.watch(what, done, 8)
    lines = terminal.getvalue().split("\r\x1b[K")
    assert lines[1] == "reading: 1 of 8 recordings  0:00 left"
    assert lines[-1] == "alignment: 4 of 8 recordings  0:01 left"


def test_a_signal_that_ray_replaces_keeps_its_exit_code() -> None:
    program = """
import os, signal, typer
from cvo_edge.process import guarded
app = typer.Typer()
@app.command()
def wait(what: str):
    try:
        os.kill(os.getpid(), signal.SIGTERM)
    except SystemExit:
        raise SystemExit(1) from None
guarded("cvo-edge", app)
"""
    command = [sys.executable, "-c", program, "until killed"]
    assert subprocess.run(command, check=False).returncode == 143
