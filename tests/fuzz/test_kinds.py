"""A short ``make fuzz``: no findings, and every kind of trial has its expected effect."""

import numpy as np
import pytest

from fuzz import bundles, kills, media, sensors, simulation, states
from fuzz.__main__ import KINDS, main
from fuzz.mutate import changed_bytes, changed_document, with_digest
from fuzz.trials import Ended

SHORT = {
    "models": 24,
    "models_that_fit": 8,
    "calibrations": 400,
    "calibrations_that_fit": 6,
    "kills": 4,
    "states": 24,
    "sensors": 200,
    "recordings": 40,
    "images": 40,
    "videos": 6,
    "coverage": 100,
}
# An outcome that at least one trial of each kind must have; otherwise the trials had no effect.
SEEN = {
    "models": "exit code 5",
    # An invalid model, which is reached only if the digests fit.
    "models_that_fit": "exit code 4",
    "kills": "whole",
    "states": "the old state, and an unfinished file",
    "calibrations": "exit code 3",
    "calibrations_that_fit": "exit code 3",
    "sensors": "frozen, degraded",
    "images": "invalid",
    "videos": "exit code 6",
    "coverage": "n 19, 0.99: unbounded",
}


def test_every_kind_is_here():
    assert SHORT.keys() == KINDS.keys()


@pytest.mark.parametrize("kind", SHORT)
def test_nothing_is_found(kind):
    _, _, trials = KINDS[kind]
    tally = trials(SHORT[kind])
    assert tally.findings == []
    if kind == "recordings" and not tally.trials:
        pytest.skip("CVO_DATA is not set: no real recordings")
    assert tally.trials >= SHORT[kind]
    assert tally.outcomes[SEEN.get(kind, "")] > 0 or kind not in SEEN


@pytest.mark.parametrize("word", ["models=0", "kills=-5", "images=x", "nothing"])
def test_invalid_names_and_counts_are_refused(monkeypatch, word):
    monkeypatch.setattr("sys.argv", ["fuzz", word])
    assert main() == 2


def test_disabled_checks_lead_to_findings(monkeypatch, artifacts_dir):
    # A reader that checks no digests accepts everything.
    monkeypatch.setattr(bundles, "read_bundle", lambda _: None)
    assert len(bundles.models(4).findings) == len(bundles.calibrations(4).findings) == 4
    # Without frame checks, every faulted frame gets an interval.
    monkeypatch.setattr("cvo_edge.engine.observation.image_doubt", lambda _: None)
    monkeypatch.setattr("cvo_edge.input.frame_checks.StreamChecks.picture", lambda *_: ())
    assert sensors.sensors(40).findings
    monkeypatch.setattr(simulation, "conformal_quantile", lambda scores, _: scores.max())
    assert simulation.coverage(10).findings


def test_what_was_seen_and_is_not_there_is_lost(monkeypatch):
    monkeypatch.setattr(kills, "read_records", lambda _: iter(()))
    assert list(kills.kills(1).outcomes) == ["lost"]


def test_a_writer_that_leaves_half_a_state_or_an_older_one_is_found(monkeypatch):
    program = "import fuzz.states as s; w = s.StateFile.write; s.StateFile.write = {}; s.serve()"
    half = "lambda self, _: self.path.write_bytes(b'{')"
    monkeypatch.setattr(states, "_PROGRAM", program.format(half))
    assert list(states.states(1).outcomes) == ["unreadable"]
    older = "lambda self, state: state.labels or w(self, state)"
    monkeypatch.setattr(states, "_PROGRAM", program.format(older))
    assert "another state" in states.states(4).outcomes


def test_another_pose_behind_a_damaged_image_is_found(monkeypatch):
    monkeypatch.setattr(media, "_as_ever", lambda: {f"{number:03d}": None for number in range(20)})
    assert media.images(20).findings


@pytest.mark.parametrize(
    ("ended", "said"),
    [
        (Ended(None, b"", "", 9.0), "still running"),
        (Ended(-11, b"", "", 1.0), "exit code -11"),
        (Ended(4, b"", "Traceback (most recent call last):", 1.0), "traceback: "),
        (Ended(4, b"", "one\ntwo\n", 1.0), "expected one line"),
        (Ended(4, b"", "one\n", 1.0), None),
    ],
)
def test_what_a_command_must_not_do(ended, said):
    found = ended.misbehaviour((0, 4))
    assert (found is None) if said is None else said in found


def test_what_is_changed_is_another_and_its_digest_fits(bundle_dir):
    content = (bundle_dir / "calibration.json").read_bytes()
    assert with_digest(content) == content
    for seed in range(50):
        assert changed_bytes(content, np.random.default_rng(seed)) != content
    model = (bundle_dir / "model.onnx").read_bytes()
    same = bundles.onnx.load_from_string(model).SerializeToString()
    for seed in range(40):
        assert bundles._changed_graph(model, np.random.default_rng(seed)) != same
    document = {"a": [1, 2.5, "x"], "b": {"c": None, "digits": 12}}
    changed = {changed_document(document, np.random.default_rng(seed)) for seed in range(50)}
    assert len(changed) > 40
