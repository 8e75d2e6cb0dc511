"""The number of usable cores, and exact products of 8-bit numbers."""

from __future__ import annotations

import math
import os
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import onnxruntime
import pytest

from cvo_edge.engine import session
from cvo_edge.engine.cores import allowed_cores, cgroup_cores
from cvo_edge.errors import ModelError
from cvo_edge.input import preprocess
from cvo_edge.odometer import Odometer


def cores(folder: Path, groups: str, files: dict[str, str]) -> float:
    (folder / "groups").write_text(groups)
    for name, content in files.items():
        path = folder / "mount" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(content)
    return cgroup_cores(folder / "groups", folder / "mount")


@pytest.mark.parametrize(
    ("groups", "files", "expected"),
    [
        ("0::/\n", {"cpu.max": "150000 100000\n"}, 1.5),
        ("0::/\n", {"cpu.max": "max 100000\n"}, math.inf),
        ("0::/\n", {}, math.inf),
        ("0::/a/b\n", {"a/b/cpu.max": "max 100000", "a/cpu.max": "50000 100000"}, 0.5),
        ("0::/a\n", {"a/cpu.max": "300000 100000", "cpu.max": "200000 100000"}, 2.0),
        (
            "4:memory:/x\n3:cpu,cpuacct:/a\n",
            {"cpu/a/cpu.cfs_quota_us": "250000\n", "cpu/a/cpu.cfs_period_us": "100000\n"},
            2.5,
        ),
        (
            "3:cpu:/a\n",
            {"cpu/a/cpu.cfs_quota_us": "-1\n", "cpu/a/cpu.cfs_period_us": "100000\n"},
            math.inf,
        ),
        ("0::/\n", {"cpu.max": "nonsense"}, math.inf),
        ("0::/\n", {"cpu.max": "1 0"}, math.inf),
    ],
)
def test_the_smallest_quota_of_a_group_and_those_above_holds(tmp_path, groups, files, expected):
    assert cores(tmp_path, groups, files) == expected


def test_no_control_groups_are_no_quota(tmp_path):
    assert cgroup_cores(tmp_path / "none", tmp_path) == math.inf


@pytest.mark.parametrize(("quota", "expected"), [(math.inf, 2), (0.3, 1), (1.2, 2), (64.0, 2)])
def test_cores_are_those_of_affinity_and_quota(monkeypatch, quota, expected):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 5})
    monkeypatch.setattr("cvo_edge.engine.cores.cgroup_cores", lambda: quota)
    assert allowed_cores() == expected


@pytest.mark.parametrize(
    ("cores", "threads", "expected"),
    [
        ({0, 1}, 2, [0, 1]),
        ({7, 4, 6}, 3, [4, 6, 7]),
        ({0, 1}, 1, []),
        ({0, 1, 2, 3}, 2, []),
        ({0}, 2, []),
    ],
)
def test_every_core_has_one_thread_where_there_are_as_many(cores, threads, expected, monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: cores, raising=False)
    assert session.cores_of_threads(threads) == expected


@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="Linux alone has it")
@pytest.mark.parametrize("spinning", [True, False])
def test_a_callers_thread_is_where_it_was_after_an_inference(bundle, spinning):
    cores = os.sched_getaffinity(0)
    model = bundle.calibration.model
    loaded = session.Session(bundle.model_bytes, len(cores), model, spinning=spinning)
    image = np.zeros(model.inputs[0].shape, np.uint8)
    loaded.run({"image": image})
    assert os.sched_getaffinity(0) == cores
    with pytest.raises(ModelError):
        loaded.run({"picture": image})
    assert os.sched_getaffinity(0) == cores


@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="Linux alone has it")
def test_a_thread_that_its_owner_has_pinned_is_never_moved(bundle, monkeypatch):
    """Neither one that was pinned since the model was loaded, nor one pinned during a call."""
    mask, moves = [{4, 5}], []
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(mask[0]))
    monkeypatch.setattr(
        os, "sched_setaffinity", lambda _, to: moves.append(to) or mask.insert(0, to)
    )
    loaded = session.Session(bundle.model_bytes, 1, bundle.calibration.model)
    loaded.caller_core, loaded._cores = frozenset({4}), {4, 5}
    loaded.engine = SimpleNamespace(run=lambda *_: [])
    loaded._call({})
    assert moves == [{4}, {4, 5}]
    loaded.engine = SimpleNamespace(run=lambda *_: mask.insert(0, {5}))
    loaded._call({})
    assert mask[0] == {5}
    moves.clear()
    loaded._call({})
    assert (mask[0], moves) == ({5}, [])


def test_callers_of_two_models_have_a_core_each(monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {2, 3, 7}, raising=False)
    assert session.cores_of_threads(3, [2]) == [3, 2, 7]
    assert session.cores_of_threads(3, [2, 3, 7, 2]) == [3, 2, 7]


def test_a_core_that_is_taken_away_costs_the_pinning_alone(bundle):
    with Odometer(bundle, threads=1) as odometer:
        image = preprocess.selftest_image(192, 256)
        expected = odometer.observe(image, 0)
        # Simulate a control group that has removed the core since.
        odometer.session.caller_core, odometer.session._cores = {1023}, os.sched_getaffinity(0)
        before = os.sched_getaffinity(0)
        for _ in range(2):
            found = odometer.observe(image, 0)
            assert np.array_equal(found.pose, expected.pose)
        assert os.sched_getaffinity(0) == before


def test_sums_of_8_bit_products_are_exact_as_a_session_is_set_up():
    """On x86 without VNNI, sums are exact only with the session's precise setting."""
    options = onnxruntime.SessionOptions()
    precise = str(int(session.saturates()))
    options.add_session_config_entry("session.x64quantprecision", precise)
    engine = onnxruntime.InferenceSession(
        session._PRODUCT, options, providers=["CPUExecutionProvider"]
    )
    for value in (0, 1, 255):
        (found,) = engine.run(None, {"a": np.full((1, 32), value, np.uint8)})
        assert found.tolist() == [[32 * value * 127]]
