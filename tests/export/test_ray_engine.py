"""The Ray engine: the same outcomes as local processes, also after losing a worker."""

import os
import signal
import socket
import subprocess
import sys
from functools import partial
from pathlib import Path

import pytest

from cvo_edge.cluster import ray_cluster
from cvo_edge.errors import UsageError
from cvo_edge.spread import OnRay
from cvo_export.study.ray_engine import ray_engine

pytest.importorskip("ray")

# The script next to the interpreter belongs to the same environment.
RAY = Path(sys.executable).with_name("ray")


@pytest.fixture
def cluster(monkeypatch):
    """A cluster on this machine alone, at a free address, stopped after the test."""
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{found.getsockname()[1]}"
    monkeypatch.setenv("RAY_ADDRESS", address)
    # Ignore any tokens of this machine's user.
    monkeypatch.setenv("RAY_AUTH_MODE", "disabled")
    options = [f"--port={address.split(':')[1]}", "--node-ip-address=127.0.0.1", "--num-cpus=2"]
    quiet = ["--include-dashboard=false", "--disable-usage-stats"]
    command = [RAY, "start", "--head", "--block", *options, *quiet]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as head:
        try:
            health = [RAY, "health-check", "--address", address]
            while subprocess.run(health, check=False, capture_output=True).returncode != 0:
                assert head.poll() is None
            yield
        finally:
            head.terminate()


def write(path, text):
    path.write_text(text)


def refuse():
    raise UsageError("no")


def die_once(path):
    """Kill this process the first time; succeed the second time."""
    if not path.exists():
        path.write_text("once")
        os.kill(os.getpid(), signal.SIGKILL)
    path.write_text("twice")


def square(number, other):
    if number > 90:
        raise UsageError(f"no {number}")
    return number * other


def test_outcomes_are_those_of_the_tasks_and_a_killed_worker_is_run_again(
    cluster, tmp_path, monkeypatch
):
    tasks = {
        "write": partial(write, tmp_path / "written", "by a worker"),
        "refuse": refuse,
        "die": partial(die_once, tmp_path / "died"),
        "where": partial(write, Path("relative"), "to the folder of the study"),
    }
    found, begun = {}, Path.cwd()
    before = signal.getsignal(signal.SIGTERM)
    with ray_engine() as run:
        # The engine must not replace the handler that sets our exit codes.
        assert signal.getsignal(signal.SIGTERM) == before
        # Workers still find the modules of the folder in which they were started.
        monkeypatch.chdir(tmp_path)
        run(tasks, found.__setitem__)
    assert set(found) == set(tasks)
    assert found["write"] is None
    assert (tmp_path / "written").read_text() == "by a worker"
    assert (tmp_path / "relative").read_text() == "to the folder of the study"
    assert type(found["refuse"]) is UsageError
    assert str(found["refuse"]) == "no"
    assert found["die"] is None
    assert (tmp_path / "died").read_text() == "twice"
    (tmp_path / "died").unlink()
    # Workers of another session find modules in the folder where it begins.
    monkeypatch.chdir(begun)
    told = []
    with ray_cluster("test", "cvo-edge") as ray:
        numbers = OnRay.of(ray, list(range(100)), lambda *words: told.append(words))
        squares = numbers.take(range(80)).map(square, range(80), what="squares")
        assert squares.collect() == [number**2 for number in range(80)]
        assert told[-1] == ("squares", 80, 80)
        with pytest.raises(UsageError, match="no 91"):
            numbers.map(square, range(100)).map(str).collect()
        OnRay.of(ray, [tmp_path / "died"]).map(die_once).collect()
    assert (tmp_path / "died").read_text() == "twice"


@pytest.mark.parametrize(
    "address", ["127.0.0.1:9", "nonsense", "ray://127.0.0.1:10001", "127.0.0.1:99999999"]
)
def test_an_address_where_no_cluster_is_is_refused_at_once(address, monkeypatch):
    monkeypatch.setenv("RAY_ADDRESS", address)
    with pytest.raises(UsageError, match=f"no Ray cluster at {address};"), ray_engine():
        raise AssertionError


def test_no_address_at_all_is_refused(monkeypatch, tmp_path):
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    monkeypatch.setenv("RAY_TMPDIR", str(tmp_path))
    with pytest.raises(UsageError, match="no Ray cluster at any address; start one"), ray_engine():
        raise AssertionError
    # A killed head node leaves this file behind.
    (tmp_path / "ray").mkdir()
    (tmp_path / "ray" / "ray_current_cluster").write_text("127.0.0.1:9")
    with pytest.raises(UsageError, match=r"no Ray cluster at 127.0.0.1:9;"), ray_engine():
        raise AssertionError


@pytest.mark.parametrize(
    ("environment", "has_token", "expected"),
    [
        ({}, False, None),
        ({}, True, "token"),
        ({"RAY_AUTH_TOKEN": "secret"}, False, "token"),
        ({"RAY_AUTH_MODE": "disabled"}, True, "disabled"),
    ],
)
def test_a_token_is_used_where_ray_start_uses_it(
    environment, has_token, expected, monkeypatch, tmp_path
):
    for name in ("RAY_AUTH_MODE", "RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH"):
        monkeypatch.delenv(name, raising=False)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setenv("HOME", str(tmp_path))
    if has_token:
        (tmp_path / ".ray").mkdir()
        (tmp_path / ".ray" / "auth_token").write_text("secret")
    monkeypatch.setenv("RAY_ADDRESS", "127.0.0.1:9")
    with pytest.raises(UsageError, match="no Ray cluster"), ray_engine():
        raise AssertionError
    assert os.environ.get("RAY_AUTH_MODE") == expected
    # The engine sets this variable, so monkeypatch does not remove it.
    os.environ.pop("RAY_AUTH_MODE", None)
