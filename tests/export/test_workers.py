"""Tasks in processes: every task runs, failures keep their type, and no process is left behind."""

import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import pytest

from cvo_edge.bundle.reading import read_calibration
from cvo_edge.errors import CalibrationFileError, SinkError
from cvo_export.study.workers import TaskError, run_tasks


@pytest.mark.parametrize("jobs", [1, 2])
def test_a_failure_keeps_its_kind_and_the_other_tasks_run(tmp_path, jobs, capfd):
    tasks = {
        "touch": partial(Path.touch, tmp_path / "first"),
        "refused": partial(read_calibration, tmp_path / "none"),
        "full": partial(os.mkdir, tmp_path / "no" / "such"),
        "defect": partial(int, "x"),
        "again": partial(Path.touch, tmp_path / "second"),
    }
    found = {}
    run_tasks(jobs, tasks, found.__setitem__)
    assert found.keys() == tasks.keys()
    assert found["touch"] is None
    assert found["again"] is None
    assert {path.name for path in tmp_path.iterdir()} == {"first", "second"}
    assert isinstance(found["refused"], CalibrationFileError)
    assert isinstance(found["full"], SinkError)
    assert isinstance(found["defect"], TaskError)
    assert str(found["defect"]).startswith("ValueError: invalid literal")
    assert all("\n" not in str(error) for error in found.values())
    # A programming error also needs its traceback, not just one line.
    assert "Traceback" in capfd.readouterr().err


def test_a_process_that_dies_is_a_failure_of_its_task(tmp_path):
    found = {}
    tasks = {
        "dies": partial(signal.raise_signal, signal.SIGKILL),
        "lives": partial(Path.touch, tmp_path / "file"),
    }
    run_tasks(2, tasks, found.__setitem__)
    assert str(found["dies"]) == "its process ended with exit code -9"
    assert found["lives"] is None


def _wait_for(condition):
    while not condition():
        time.sleep(0.05)


def _alive(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_no_process_is_left_behind_by_a_signal(tmp_path, number):
    sleep = (
        "import os, pathlib, time; pid = os.getpid();"
        f"file = pathlib.Path({str(tmp_path)!r}, str(pid));"
        "file.touch(); time.sleep(300)"
    )
    code = (
        "import signal, sys; from functools import partial\n"
        # The process that starts the tests may ignore SIGINT, which children inherit.
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "from cvo_export.study.workers import run_tasks\n"
        "signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))\n"
        f"tasks = {{name: partial(exec, {sleep!r}) for name in 'abc'}}\n"
        "run_tasks(2, tasks, lambda *_: None)"
    )
    parent = subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.DEVNULL)
    try:
        _wait_for(lambda: len(list(tmp_path.iterdir())) == 2)
        children = [int(path.name) for path in tmp_path.iterdir()]
        assert all(_alive(pid) for pid in children)
        parent.send_signal(number)
        assert parent.wait() != 0
        _wait_for(lambda: not any(_alive(pid) for pid in children))
        assert len(list(tmp_path.iterdir())) == 2
    finally:
        parent.kill()
