"""The statistics of familiarity: their formulas against independent ones, and their graph."""

from __future__ import annotations

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper
from scipy.spatial.distance import cdist, mahalanobis

from cvo_edge.bundle.reading import read_calibration
from cvo_edge.engine.session import Session
from cvo_edge.errors import GateError
from cvo_edge.monitor.alarm import Running, StreamAlarm
from cvo_export.bundles.alarm import Statistics, fitted_alarm
from cvo_export.data.harmless import HARMLESS
from cvo_export.graph import familiarise
from cvo_export.graph.familiarity import colour_numbers, fitted, neighbours, spread_pairs
from cvo_export.graph.familiarity_nodes import with_familiarity

_CELLS, _CHANNELS = 6, 8


def _fitted(channels=_CHANNELS, seed=0):
    generator = np.random.default_rng(seed)
    mixing = generator.normal(size=(channels, channels))
    cells = (generator.normal(size=(400, _CELLS, channels)) @ mixing).astype(np.float32)
    near = cells[:40] + 0.1 * generator.normal(size=(40, _CELLS, channels)).astype(np.float32)
    noisy = cells[:80] + 5.0 * generator.normal(size=(80, _CELLS, channels)).astype(np.float32)
    pixels = generator.integers(0, 255, (400, 6, 8, 3)).astype(np.uint8)
    pairs = neighbours(np.arange(400), np.repeat([0, 1], 200))
    return fitted(cells, pairs, (np.arange(40), near), noisy, pixels, 0), cells, noisy, pixels


def test_distances_are_those_of_scipy():
    found, cells, _, pixels = _fitted()
    values = found.novelty(cells[:5], pixels[:5])
    z = found.projected(cells)
    for row in range(5):
        nearest = [
            cdist(z[row, k, None], found.prototypes[k].astype(np.float64)).min()
            for k in range(_CELLS)
        ]
        assert values[row, 0] == pytest.approx(max(nearest), abs=1e-6)
    rows = cells[:, 0].astype(np.float64)
    covariance = np.cov(rows, rowvar=False, bias=True)
    # Ledoit-Wolf's form, with a fixed share.
    covariance += 0.05 * np.trace(covariance) / _CHANNELS * np.eye(_CHANNELS)
    direct = [mahalanobis(row, rows.mean(axis=0), np.linalg.inv(covariance)) for row in rows]
    ours = np.sqrt(np.square(z[:, 0]) @ found.precision[0] * _CHANNELS)
    assert ours == pytest.approx(direct, rel=0.02)


def test_a_frame_that_was_seen_is_near_and_another_place_is_far():
    found, cells, _, pixels = _fitted()
    own = found.novelty(cells[:50], pixels[:50])
    other = found.novelty(cells[:50] + 20.0, pixels[:50])
    assert other[:, :3].min() > own[:, :3].max()
    tinted = (pixels[:50] * np.array([1.0, 0.6, 0.3])).astype(np.uint8)
    assert found.novelty(cells[:50], tinted)[:, 3].min() > np.median(own[:, 3])


def test_degradation_tells_noisy_features_from_clean_ones():
    found, cells, noisy, _ = _fitted()
    clean, dirty = found.degradation(cells)[:, 0], found.degradation(noisy)[:, 0]
    assert np.mean(clean < 0.0) > 0.95
    assert np.mean(dirty > 0.0) > 0.95


@pytest.mark.parametrize("channels", [_CHANNELS, 200])
def test_the_graph_gives_what_the_formulas_give(channels):
    found, cells, _, pixels = _fitted(channels)
    cell = helper.make_tensor_value_info("cells", TensorProto.FLOAT, [1, _CELLS, channels])
    pixel = helper.make_tensor_value_info("pixels", TensorProto.UINT8, [1, 6, 8, 3])
    inputs = [
        helper.make_tensor_value_info("f", TensorProto.FLOAT, [1, _CELLS, channels]),
        helper.make_tensor_value_info("p", TensorProto.UINT8, [1, 6, 8, 3]),
    ]
    nodes = [
        helper.make_node("Identity", ["f"], ["cells"]),
        helper.make_node("Identity", ["p"], ["pixels"]),
    ]
    graph = helper.make_graph(nodes, "before", inputs, [cell, pixel])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10)
    session = Session(with_familiarity(model.SerializeToString(), found))
    assert [spec.name for spec in session.outputs] == ["novelty", "degradation"]
    for row in range(5):
        outputs = session.run({"f": cells[row : row + 1], "p": pixels[row : row + 1]})
        novelty = found.novelty(cells[row : row + 1], pixels[row : row + 1])
        assert outputs["novelty"] == pytest.approx(novelty, rel=1e-3)
        degradation = found.degradation(cells[row : row + 1])
        assert outputs["degradation"] == pytest.approx(degradation, rel=1e-3, abs=1e-3)


def test_a_graph_that_disagrees_is_refused(tiny_run, monkeypatch):
    class Wrong:
        def __call__(self, content, fitted):
            model = onnx.load_from_string(with_familiarity(content, fitted))
            for constant in model.graph.initializer:
                values = onnx.numpy_helper.to_array(constant)
                if constant.name.startswith("familiarity/") and values.dtype == np.float32:
                    wrong = onnx.numpy_helper.from_array(values + np.float32(0.5), constant.name)
                    constant.CopyFrom(wrong)
            return model.SerializeToString()

    from cvo_export.publish import _export

    monkeypatch.setattr(familiarise, "with_familiarity", Wrong())
    with pytest.raises(GateError, match="agree with its formula"):
        _export(tiny_run, tiny_run.graph.head, tiny_run.training_frames, "fp32", "onnxruntime")


def test_colour_numbers_are_means_of_quarters_and_covariances():
    pixels = np.random.default_rng(0).integers(0, 255, (1, 4, 6, 3)).astype(np.uint8)
    found = colour_numbers(pixels)[0]
    r, g, b = pixels[0].astype(np.float64).transpose(2, 0, 1) / 255.0
    light, first, second = (r + g + b) / 3.0, r - b, g - 0.5 * (r + b)
    assert found[:3] == pytest.approx([c[:2, :3].mean() for c in (light, first, second)])
    assert found[9:12] == pytest.approx([c[2:, 3:].mean() for c in (light, first, second)])
    covariance = np.cov([c.ravel() for c in (light, first, second)], bias=True)
    assert found[12:] == pytest.approx(covariance[np.triu_indices(3)])


def test_neighbours_follow_each_other_in_one_recording():
    indices = np.array([0, 1, 5, 6, 7])
    assert neighbours(indices, np.array([0] * 6 + [1] * 4)).tolist() == [[0, 1], [1, 2], [3, 4]]
    kept = spread_pairs(1000, 100)
    assert len(kept) <= 100
    assert np.mean(np.diff(kept) == 1) >= 0.5


def test_new_frames_are_beyond_the_limits_as_rarely_as_stated():
    generator = np.random.default_rng(3)
    sequence = np.zeros(400, np.int64)
    frames = [Statistics(generator.standard_t(4, (400, 5)), sequence) for _ in range(4)]
    spec = fitted_alarm("random", (frames[0], frames[1]), (frames[2], frames[2]))
    new = (generator.standard_t(4, (20_000, 5)) - np.array(spec.usual)) / np.array(spec.scales)
    share = np.mean(new.max(axis=1) > spec.limits[0])
    # 400 draws set the limit: its own level has a deviation of half a percent.
    assert abs(share - 0.01) < 3.0 * 0.005


def test_a_split_into_frames_limits_frames(tiny_bundle):
    alarm = read_calibration(tiny_bundle).alarm
    assert alarm is not None
    assert alarm.kind == "frames"


@pytest.mark.parametrize("change", HARMLESS)
def test_harmless_changes_change_little_and_something(change):
    image = np.random.default_rng(0).integers(60, 180, (48, 64, 3)).astype(np.uint8)
    image = np.repeat(np.repeat(image[::8, ::8], 8, axis=0), 8, axis=1)
    changed = change(image, np.random.default_rng(2))
    assert changed.shape == image.shape
    assert changed.dtype == np.uint8
    difference = np.abs(changed.astype(float) - image)
    assert 0.0 < difference.mean() < 25.0


def _recordings(seed=0):
    generator = np.random.default_rng(seed)
    sequence = np.repeat(np.arange(6), 30)
    val, changed_val, cal, changed_cal = (
        Statistics(generator.normal(size=(180, 5)), sequence) for _ in range(4)
    )
    return (val, changed_val), (cal, changed_cal)


def test_limits_of_recordings_are_their_largest_running_values():
    val, cal = _recordings()
    spec = fitted_alarm("sequence", val, cal)
    assert (spec.kind, spec.n) == ("recordings", 6)
    largest = np.zeros(5)
    for each in cal:
        for number in range(6):
            running = Running((np.inf,) * 5)
            rows = (each.values[each.sequence == number] - spec.usual) / spec.scales
            found = np.array([running.add(row) for row in rows.tolist()])
            largest = np.maximum(largest, found.max(axis=0))
    assert spec.limits == pytest.approx(largest)


def test_novelties_of_recordings_are_those_of_new_ones():
    val, cal = _recordings()
    recordings = fitted_alarm("sequence", val, cal).recordings
    assert recordings is not None
    for number, mean in enumerate(recordings):
        # What the records of a new recording would give, of a bundle that never saw it.
        own, others = (
            tuple(Statistics(each.values[rows], each.sequence[rows]) for each in cal)
            for rows in (cal[0].sequence == number, cal[0].sequence != number)
        )
        alarm = StreamAlarm(fitted_alarm("sequence", val, others))
        outputs = ({"novelty": row[:4], "degradation": row[4:]} for row in own[0].values)
        novelties = [alarm.judge(each, seq).novelty for seq, each in enumerate(outputs)]
        assert mean == pytest.approx(np.mean(novelties), abs=1e-4)
        assert fitted_alarm("sequence", val, own).recordings is None


def test_limits_of_frames_are_beyond_all_but_a_hundredth():
    val, cal = _recordings()
    spec = fitted_alarm("random", val, cal)
    r = (cal[0].values - np.array(spec.usual)) / np.array(spec.scales)
    assert (spec.kind, spec.recordings) == ("frames", None)
    assert np.mean(r.max(axis=1) > spec.limits[0]) <= 0.01
