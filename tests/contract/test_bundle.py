"""The bundle: round trip, and rejection of invalid bytes."""

import hashlib
import json
import os
import shutil
import time
from pathlib import Path

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cvo_edge import BundleMismatchError, CalibrationFileError, ModelError, Odometer
from cvo_edge.bundle.format import MODEL_FILE
from cvo_edge.bundle.reading import decode_calibration, encode_calibration, read_calibration
from cvo_edge.engine.loading import read_bundle


def redigested(document):
    """Encode a document with a matching digest, as an attacker or a bug could."""
    document = {**document, "digest": "0" * 64}
    content = json.dumps(document).encode("utf-8")
    return content.replace(b"0" * 64, hashlib.sha256(content).hexdigest().encode())


@pytest.fixture(scope="module")
def content(bundle_dir):
    return (bundle_dir / "calibration.json").read_bytes()


@pytest.fixture(scope="module")
def document(content):
    return json.loads(content)


def test_writing_what_was_read_gives_the_same_bytes(content):
    assert encode_calibration(decode_calibration(content)) == content


def test_the_file_is_small_and_names_no_path(content):
    assert len(content) < 64 * 1024
    provenance = json.dumps(json.loads(content)["provenance"])
    assert "/" not in provenance


def test_redigesting_the_same_document_is_accepted(document):
    assert decode_calibration(redigested(document)).name == document["name"]


def replaced(document, path, value):
    """Return a deep copy of the document with one value replaced; ``...`` deletes the key."""
    copy = json.loads(json.dumps(document))
    *parents, last = path
    node = copy
    for key in parents:
        node = node[key]
    if value is ...:
        del node[last]
    else:
        node[last] = value
    return copy


REFUSED = [
    (("schema_version",), 4, "schema_version: expected 1, 2 or 3, found 4"),
    (("schema_version",), 3, "expected 1 for a bundle without quantiles, found 3"),
    (("schema_version",), "1", "schema_version"),
    (("schema_version",), True, "schema_version"),
    (("name",), ..., "missing required field `name`"),
    (("extra",), 1, "unknown field `extra`"),
    (("model", "extra"), 1, "unknown field `extra`"),
    (("method",), "", "method"),
    (("method",), 3, "method"),
    (("model", "file"), "../model.onnx", "model.file"),
    (("model", "sha256"), "0" * 63, "model.sha256"),
    (("model", "opset"), 18.5, "model.opset"),
    (("model", "precision"), "fp16", "model.precision"),
    (("model", "inputs"), [], "model.inputs"),
    (("preprocess", "height"), "192", "preprocess.height"),
    (("preprocess", "height"), 0, "preprocess.height"),
    (("preprocess", "width"), 320, "model.inputs"),
    (("preprocess", "std"), [0.5, 0.5, 0], "preprocess.std"),
    (("preprocess", "in_graph"), [], "preprocess.in_graph"),
    (("preprocess", "in_graph"), ["cast", "cast", "cast"], "preprocess.in_graph"),
    (("name",), "two\nlines", "name"),
    (("name",), "\ud800", "name"),
    (("name",), "\x1b[31m", "name"),
    (("preprocess", "std"), [0.5, 0.5, -0.5], "preprocess.std"),
    (("pose", "standard_deviation"), [1, 1, 1, 1, 1, True], "standard_deviation"),
    (("pose", "standard_deviation"), [1, 1, 1, 1, 1], "standard_deviation"),
    (("pose", "rotation"), "quaternion", "pose.rotation"),
    (("pose", "reference_q_xyzw"), None, "reference_q_xyzw"),
    (("pose", "reference_q_xyzw"), [0, 0, 0, 2], "norm 1"),
    (("pose", "reference_q_xyzw"), [1e308] * 4, "reference_q_xyzw"),
    (("pose", "limits", "lowest"), [9e8] * 6, "lowest < highest"),
    (("pose", "limits", "highest", 2), 1e9, "pose.limits.highest"),
    (("pose", "standard_deviation", 0), 1e9, "standard_deviation"),
    (("thresholds",), [], "thresholds"),
    (("thresholds", 0, "confidence"), 1.0, "confidence"),
    (("thresholds", 4), ..., "missing 0.9"),
    (("thresholds", 0, "q_hat"), [1, 2, 3], "q_hat"),
    (("thresholds", 0, "q_hat", 0), "1", "q_hat"),
    (("thresholds", 0, "q_hat", 0), 9e8, "grow with the confidence"),
    (("thresholds", 0, "q_hat", 0), -1.7e308, "q_hat"),
    (("thresholds", 0, "q_hat", 0), 10**19, "q_hat"),
    (("selftest", "outputs", "pose", 0), 1e9, "selftest.outputs"),
    (("thresholds", 0, "q_hat", 0), None, "grow with the confidence"),
    (("calibration", "n"), 0, "calibration.n"),
    (("calibration", "n"), -5, "calibration.n"),
    (("calibration", "rule"), "best", "calibration.rule"),
    (
        ("calibration", "rule"),
        "hierarchical",
        "calibration.cap: expected a number with the rule capped and null with the others, found "
        "0.5 with hierarchical",
    ),
    (
        ("calibration", "cap"),
        ...,
        "calibration.cap: expected a number with the rule capped and null with the others, found "
        "null with capped",
    ),
    (("calibration", "cap"), 1.5, "calibration.cap"),
    (("calibration", "cap"), 0, "calibration.cap"),
    (("thresholds", 0, "left_out"), {"coverage": 1.1, "standard_error": 0}, "left_out.coverage"),
    (("calibration", "n"), 10**19, "calibration.n"),
    (("selftest", "tolerance"), -1.0, "selftest.tolerance"),
    (("selftest", "tolerance"), 1e300, "selftest.tolerance"),
    (("selftest", "outputs", "pose"), [1.0], "selftest.outputs"),
    (("provenance", "seed"), -1, "provenance.seed"),
]


@pytest.mark.parametrize(("path", "value", "rule"), REFUSED, ids=lambda v: str(v)[:40])
def test_a_wrong_value_names_the_key(document, path, value, rule):
    with pytest.raises(CalibrationFileError) as caught:
        decode_calibration(redigested(replaced(document, path, value)))
    message = str(caught.value)
    assert rule in message.replace("$.", "").replace("`$.", "`")
    assert "\n" not in message


def test_a_method_that_nobody_registered_is_refused_at_load(copied_bundle, document):
    (copied_bundle / "calibration.json").write_bytes(
        redigested(replaced(document, ("method",), "magic"))
    )
    with pytest.raises(CalibrationFileError, match="method: expected one of cjp, cqr, csp, mcqr"):
        read_bundle(copied_bundle)


METHOD_PARAMETERS = [
    ("half_width_floor", [1, 1, 1, 1, 1, 0]),
    ("half_width_floor", [1, 1, 1, 1, 1, 1e308]),
    ("latent", "median"),
    ("latent_size", 0),
    ("latent_size", 10**12),
    ("surplus", 1),
]


@pytest.mark.parametrize(("key", "value"), METHOD_PARAMETERS)
def test_wrong_method_parameters_are_refused_at_load(copied_bundle, document, key, value):
    wrong = redigested(replaced(document, ("method_parameters", key), value))
    (copied_bundle / "calibration.json").write_bytes(wrong)
    with pytest.raises(CalibrationFileError, match="method_parameters"):
        Odometer.load(copied_bundle)


@pytest.mark.parametrize("change", ["latent", "noise of bytes", "output of bytes", "no output"])
def test_tensors_that_the_method_does_not_work_with_are_refused_at_load(
    copied_bundle, document, change
):
    if change == "latent":
        wrong = replaced(document, ("method_parameters", "latent"), "sample")
    elif change == "noise of bytes":
        wrong = replaced(document, ("method_parameters", "latent"), "sample")
        size = document["method_parameters"]["latent_size"]
        noise = {"name": "latent_noise", "dtype": "uint8", "shape": [1, size]}
        wrong["model"]["inputs"].append(noise)
    elif change == "output of bytes":
        wrong = replaced(document, ("model", "outputs", 0, "dtype"), "uint8")
    else:
        outputs = [each for each in document["model"]["outputs"] if each["name"] != "upper"]
        wrong = replaced(document, ("model", "outputs"), outputs)
        wrong = replaced(wrong, ("selftest", "outputs", "upper"), ...)
    (copied_bundle / "calibration.json").write_bytes(redigested(wrong))
    with pytest.raises(BundleMismatchError, match=r"model\.(inputs|outputs): expected"):
        Odometer.load(copied_bundle)


def with_joint_at(document, confidence, values):
    """Return the document with these joint q_hat at this confidence and below."""
    copy = json.loads(json.dumps(document))
    for entry in copy["thresholds"]:
        if entry["scope"] == "joint" and entry["confidence"] <= confidence:
            entry["q_hat"] = values
            entry["q_hat_upper"] = values if entry["q_hat_upper"] else None
    return copy


def marginal_at(document, confidence):
    return next(
        entry["q_hat"]
        for entry in document["thresholds"]
        if entry["scope"] == "marginal" and entry["confidence"] == confidence
    )


@pytest.mark.parametrize("method", ["cjp", "cqr", "csp"])
def test_a_joint_threshold_smaller_than_it_can_be_is_refused(tmp_path, artifacts_dir, method):
    folder = Path(shutil.copytree(artifacts_dir / f"synthetic-room-{method}", tmp_path / method))
    document = json.loads((folder / "calibration.json").read_bytes())
    least = marginal_at(document, 0.5)
    (folder / "calibration.json").write_bytes(redigested(with_joint_at(document, 0.5, least)))
    Odometer.load(folder).close()
    smaller = [*least[:5], least[5] - 1e-6]
    (folder / "calibration.json").write_bytes(redigested(with_joint_at(document, 0.5, smaller)))
    with pytest.raises(
        CalibrationFileError, match=r"scope joint at 0\.5 to be at least .* at \[5\]"
    ):
        Odometer.load(folder)


def test_of_two_sides_each_has_half_of_what_the_joint_scope_may_miss(tmp_path, artifacts_dir):
    folder = Path(shutil.copytree(artifacts_dir / "synthetic-room-cqr", tmp_path / "cqr"))
    document = json.loads((folder / "calibration.json").read_bytes())
    document["method_parameters"]["sides"] = "asymmetric"
    for entry in document["thresholds"]:
        entry["q_hat_upper"] = entry["q_hat"]
    # At 0.8 marginal, each side covers 0.9, which a joint scope at 0.9 requires of every side.
    least = marginal_at(document, 0.8)
    (folder / "calibration.json").write_bytes(redigested(with_joint_at(document, 0.9, least)))
    Odometer.load(folder).close()
    smaller = [least[0] - 1e-6, *least[1:]]
    (folder / "calibration.json").write_bytes(redigested(with_joint_at(document, 0.9, smaller)))
    with pytest.raises(
        CalibrationFileError, match=r"joint at 0\.9 to be at least .* marginal at 0\.8"
    ):
        Odometer.load(folder)


def test_a_confidence_stored_twice_is_refused(document):
    twice = [*document["thresholds"], document["thresholds"][0]]
    with pytest.raises(CalibrationFileError, match="each confidence once"):
        decode_calibration(redigested(replaced(document, ("thresholds",), twice)))


def test_a_negative_factor_is_refused(copied_bundle, document):
    wrong = replaced(document, ("thresholds", 0, "q_hat", 0), -0.5)
    wrong = replaced(wrong, ("calibration", "score"), "normalised")
    (copied_bundle / "calibration.json").write_bytes(redigested(wrong))
    with pytest.raises(CalibrationFileError, match="factors of at least 0"):
        Odometer.load(copied_bundle)


def test_a_score_of_another_method_is_refused(copied_bundle, document):
    wrong = redigested(replaced(document, ("calibration", "score"), "aps"))
    (copied_bundle / "calibration.json").write_bytes(wrong)
    with pytest.raises(CalibrationFileError, match=r"calibration\.score"):
        Odometer.load(copied_bundle)


EXACT_BYTES = {
    "byte order mark": (lambda c: b"\xef\xbb\xbf" + c, "byte order mark"),
    "not UTF-8": (lambda c: c.replace(b'"name": "', b'"name": "\xff', 1), "UTF-8"),
    "UTF-16": (lambda c: c.decode().encode("utf-16"), "UTF-8"),
    "empty": (lambda _: b"", "expected JSON"),
    "cut": (lambda c: c[: len(c) // 2], "expected JSON"),
    "list": (lambda _: b"[]", "one JSON object"),
    "number": (lambda _: b"1", "one JSON object"),
    "NaN": (lambda c: c.replace(b'"tolerance": 0.001', b'"tolerance": NaN'), "found NaN"),
    "Infinity": (lambda c: c.replace(b'"tolerance": 0.001', b'"tolerance": Infinity'), "Infinity"),
    "1e999": (lambda c: c.replace(b'"tolerance": 0.001', b'"tolerance": 1e999'), "1e999"),
    "long integer": (lambda c: c.replace(b'"opset": 18', b'"opset": ' + b"9" * 5000), "20 digits"),
    "duplicate key": (lambda c: c.replace(b"{", b'{"name": "x", ', 1), "'name' twice"),
    "nested duplicate": (
        lambda c: c.replace(b'"opset": 18', b'"opset": 18, "opset": 18'),
        "'opset' twice",
    ),
    "deep": (lambda _: b'{"a":' * 5000 + b"1" + b"}" * 5000, "nested"),
    "deep list": (lambda _: b"[" * 60000, "nested"),
    "trailing text": (lambda c: c + b"x", "expected JSON"),
    "one flipped letter": (lambda c: c.replace(b"synthetic", b"Synthetic", 1), "altered"),
    "one flipped digit of the digest": (
        lambda c: c[:-70] + c[-70:].translate(bytes.maketrans(b"0123456789", b"1234567890")),
        "altered",
    ),
    "no digest": (lambda c: c.replace(b'"digest"', b'"Digest"'), "digest"),
}


@pytest.mark.parametrize("case", EXACT_BYTES)
def test_wrong_bytes_are_refused_in_one_line(content, case):
    change, rule = EXACT_BYTES[case]
    wrong = change(content)
    assert wrong != content
    start = time.process_time()
    with pytest.raises(CalibrationFileError, match=rule) as caught:
        decode_calibration(wrong, "here/calibration.json")
    assert time.process_time() - start < 2.0
    assert "\n" not in str(caught.value)
    assert str(caught.value).startswith("here/calibration.json: ")


@settings(max_examples=150)
@given(data=st.data())
def test_no_mutated_byte_is_accepted(content, data):
    position = data.draw(st.integers(0, len(content) - 1))
    value = data.draw(st.integers(0, 255).filter(lambda v: v != content[position]))
    with pytest.raises(CalibrationFileError):
        decode_calibration(content[:position] + bytes([value]) + content[position + 1 :])


# All JSON values, including numbers that floats cannot distinguish and numeric-looking text.
json_values = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**70), 2**70)
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(max_size=8)
    | st.sampled_from(["marginal", "joint", "cjp", "csp", "1", "NaN", "\ud800"]),
    lambda inner: (
        st.lists(inner, max_size=7)
        | st.dictionaries(st.sampled_from(["q_hat", "n", "x"]), inner, max_size=3)
    ),
    max_leaves=8,
)


def places(node, path=()):
    """Yield the path of every key and element of a document."""
    pairs = node.items() if isinstance(node, dict) else enumerate(node)
    for key, value in pairs:
        yield (*path, key)
        if isinstance(value, (dict, list)):
            yield from places(value, (*path, key))


def same(one, other):
    """Whether two documents are equal: 1 equals 1.0, but not True; null is no key."""
    if isinstance(one, dict) and isinstance(other, dict):
        one, other = (
            {key: value for key, value in each.items() if value is not None}
            for each in (one, other)
        )
        return one.keys() == other.keys() and all(same(one[key], other[key]) for key in one)
    if isinstance(one, list) and isinstance(other, list):
        return len(one) == len(other) and all(map(same, one, other))
    if isinstance(one, bool) or isinstance(other, bool):
        return one is other
    if isinstance(one, (int, float)) and isinstance(other, (int, float)):
        return float(one) == float(other)
    return one == other


@settings(max_examples=400)
@given(data=st.data())
def test_what_is_accepted_is_what_was_written(document, data):
    path = data.draw(st.sampled_from(sorted(places(document), key=str)))
    value = data.draw(json_values | st.just(...))
    changed = replaced(document, path, value)
    try:
        read = decode_calibration(redigested(changed))
    except CalibrationFileError as error:
        message = str(error)
    else:
        written = json.loads(encode_calibration(read))
        assert same({**written, "digest": ""}, {**changed, "digest": ""})
        message = ""
    assert "\n" not in message


def test_what_would_be_refused_is_never_written(bundle):
    wrong = msgspec.structs.replace(bundle.calibration, thresholds=())
    with pytest.raises(CalibrationFileError):
        encode_calibration(wrong)


def test_no_folder_and_no_file(tmp_path):
    with pytest.raises(CalibrationFileError, match="no such folder"):
        read_calibration(tmp_path / "nowhere")
    with pytest.raises(CalibrationFileError, match="no such file"):
        read_calibration(tmp_path)


def test_a_file_over_the_limit_is_refused(copied_bundle):
    path = copied_bundle / "calibration.json"
    path.write_bytes(path.read_bytes() + b" " * 70_000)
    with pytest.raises(CalibrationFileError, match="at most 65536 bytes"):
        read_bundle(copied_bundle)


@pytest.mark.parametrize(
    ("name", "error"), [("calibration.json", CalibrationFileError), ("model.onnx", ModelError)]
)
def test_links_and_fifos_are_never_opened(copied_bundle, bundle_dir, name, error):
    path = copied_bundle / name
    path.unlink()
    path.symlink_to(bundle_dir / name)
    with pytest.raises(error, match=name):
        read_bundle(copied_bundle)
    path.unlink()
    os.mkfifo(path)
    with pytest.raises(error, match="regular file"):
        read_bundle(copied_bundle)


def test_a_missing_model(copied_bundle):
    (copied_bundle / "model.onnx").unlink()
    with pytest.raises(ModelError, match="no such file"):
        read_bundle(copied_bundle)


@pytest.mark.parametrize("where", [0, 0.1, 0.5, 0.999])
def test_one_flipped_bit_of_the_model_names_both_digests(copied_bundle, where):
    path = copied_bundle / "model.onnx"
    changed = bytearray(path.read_bytes())
    changed[int(where * len(changed))] ^= 1
    path.write_bytes(changed)
    expected = read_calibration(copied_bundle).model.sha256
    with pytest.raises(BundleMismatchError) as caught:
        read_bundle(copied_bundle)
    assert expected in str(caught.value)
    assert hashlib.sha256(changed).hexdigest() in str(caught.value)


def test_a_swapped_model_with_the_digest_made_to_fit_disagrees_in_its_tensors(
    copied_bundle, rewrite, bundle
):
    onnx = pytest.importorskip("onnx")
    model = onnx.load_from_string(bundle.model_bytes)
    model.graph.output[1].name, model.graph.output[2].name = "upper", "lower"
    model.graph.output[1].type.tensor_type.shape.dim[1].dim_value = 6
    for node in model.graph.node:
        for index, name in enumerate(node.output):
            if name == "pose":
                node.output[index] = "posture"
    for output in model.graph.output:
        if output.name == "pose":
            output.name = "posture"
    content = model.SerializeToString()
    (copied_bundle / MODEL_FILE).write_bytes(content)
    digest = hashlib.sha256(content).hexdigest()
    spec = msgspec.structs.replace(bundle.calibration.model, sha256=digest)
    rewrite(msgspec.structs.replace(bundle.calibration, model=spec))
    with pytest.raises((BundleMismatchError, ModelError)):
        Odometer.load(copied_bundle)


def test_bytes_that_are_no_model_are_refused_by_the_engine(copied_bundle, rewrite, bundle):
    content = b"no model at all"
    (copied_bundle / MODEL_FILE).write_bytes(content)
    digest = hashlib.sha256(content).hexdigest()
    spec = msgspec.structs.replace(bundle.calibration.model, sha256=digest)
    rewrite(msgspec.structs.replace(bundle.calibration, model=spec))
    with pytest.raises(ModelError, match="refused by onnxruntime"):
        Odometer.load(copied_bundle)


@pytest.mark.parametrize("path", [("method",), ("pose", "rotation"), ("method_parameters", "x")])
def test_half_a_character_is_refused_wherever_it_is(document, path):
    with pytest.raises(CalibrationFileError):
        decode_calibration(redigested(replaced(document, path, "\ud800")))
    with pytest.raises(CalibrationFileError):
        decode_calibration(redigested({**document, "\ud800": 1}))
