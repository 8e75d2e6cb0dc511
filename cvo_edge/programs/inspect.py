"""Readable descriptions of a bundle, a machine and a cache, and the JSON Schema."""

from __future__ import annotations

import math
from textwrap import wrap
from typing import Any

import msgspec
import numpy as np

from cvo_edge.bundle.format import (
    Calibration,
    CalibrationSpec,
    DifficultySpec,
    ImageSpec,
    Position,
    SelfTest,
)
from cvo_edge.bundle.quantiles import reaches
from cvo_edge.camera import Camera
from cvo_edge.engine.model_cache import ModelCache
from cvo_edge.errors import CalibrationFileError
from cvo_edge.guarantee import by_level, left_out_text, statement
from cvo_edge.heads import HEADS, Head
from cvo_edge.heads.checked import checked_head
from cvo_edge.heads.plausible import check_plausible, selftest_sets
from cvo_edge.monitor.alarm import alarm_statement
from cvo_edge.pose import Chart
from cvo_edge.vocabulary import Decode

# The confidence of the measured coverage that is shown.
_SHOWN = 0.9


def inspect_lines(calibration: Calibration) -> list[str]:
    """Return a readable description of a bundle; raises as ``checked_head``."""
    model, source = calibration.model, calibration.calibration
    pose, head = calibration.pose, checked_head(calibration)
    details = f", {head.description()}" if head.description() else ""
    tensors = ", ".join(f"{t.name} {list(t.shape)}" for t in (*model.inputs, *model.outputs))
    dof, scale = Chart(pose.rotation).dof, calibration.difficulty
    lines = [
        *_entry("name", calibration.name),
        *_entry("method", f"{calibration.method}, {source.score} score{details}"),
        *_entry(
            "model",
            f"{model.precision}, opset {model.opset}, sha256 {model.sha256[:16]}..., "
            f"on {model.provider}",
        ),
        *_entry("tensors", tensors),
        *_entry(
            "pose", f"{pose.target}, {pose.child_frame_id} in {pose.frame_id}, {pose.rotation}"
        ),
        *([] if pose.origin_m is None else _entry("origin", _position(pose.origin_m))),
        *_entry(
            "calibrated",
            f"on {source.n} frames of {source.n_sequences} sequence(s) of {source.dataset}, split "
            f"{source.split.kind} (seed {source.split.seed}), {_rule(source)}{_worth(source)}",
        ),
        *_crossed(source),
        *([] if calibration.camera is None else _entry("camera", _camera(calibration.camera))),
        *_images(calibration.images, calibration.preprocess.decode),
        *_entry("alarm", alarm_statement(calibration)),
        *([] if scale is None else _entry("difficulty", _difficulty(scale))),
        *_entry("joint", f"by {head.joint_description(source.joint)}"),
        *_entry("confidences", _confidences(calibration)),
        *_entry("self-test", _selftest(calibration.selftest)),
        *_entry("backbone", calibration.provenance.backbone or "a network supplied as ONNX"),
        "",
        f"{'q_hat at':<18}" + "".join(f"{name:>10}" for name in dof),
    ]
    for entry in calibration.thresholds:
        sides = [("", entry.q_hat)]
        if entry.q_hat_upper is not None:
            sides = [(" low", entry.q_hat), (" high", entry.q_hat_upper)]
        for side, values in sides:
            cells = "".join(f"{'unbounded' if v is None else _number(v):>10}" for v in values)
            lines.append(f"{f'{entry.confidence:g} {entry.scope}{side}':<18}" + cells)
    return [
        *lines,
        *_proven(calibration, head),
        *_left_out(calibration),
        *_widths(calibration, head),
        *_contradiction(calibration, head),
    ]


def _selftest(test: SelfTest) -> str:
    count = sum(map(len, test.outputs.values()))
    return (
        f"{test.width}x{test.height}, {count} numbers within {test.tolerance:g}; widths of its "
        "sets below, m and rad"
    )


def _confidences(calibration: Calibration) -> str:
    """Say which confidences a run can have, and from where on they are unbounded."""
    table = calibration.quantiles
    if table is None:
        return "those below; the bundle holds no quantiles for others"
    # Rounded downwards: beyond the end, a confidence is unbounded.
    ends = ", ".join(
        f"{each.scope} {math.floor(1e6 * each.confidence) / 1e6:g}" for each in reaches(calibration)
    )
    return f"any, by {len(table.confidences)} quantiles; finite up to {ends}"


def _difficulty(spec: DifficultySpec) -> str:
    return (
        f"sets are {math.exp(spec.lowest):.2g} to {math.exp(spec.highest):.3g} times as wide as "
        "usual, by the novelty of their frame"
    )


def _position(position_m: Position) -> str:
    return " ".join(f"{value:.10g}" for value in position_m) + " m in the world"


def _images(images: ImageSpec | None, decode: Decode) -> list[str]:
    if images is None:
        return []
    colour = "colour" if images.colour else "grey or mixed"
    half = "; JPEG files, decoded at half size" if decode == "half" else ""
    return _entry("images", f"{images.width}x{images.height}, {colour}{half}")


def _camera(camera: Camera) -> str:
    lens = ", ".join(f"{value:g}" for value in camera.coefficients)
    return (
        f"{camera.width}x{camera.height}, fx {camera.fx:g}, fy {camera.fy:g}, cx {camera.cx:g}, "
        f"cy {camera.cy:g}" + (f", {camera.distortion} {lens}" if lens else "")
    )


def _entry(label: str, text: str) -> list[str]:
    """Wrap text to 80 columns, with the label before the first line."""
    return wrap(
        text,
        80,
        initial_indent=f"{label:<13}",
        subsequent_indent=" " * 13,
        break_on_hyphens=False,
    )


def _widths(calibration: Calibration, head: Head) -> list[str]:
    """Return the widths of the self-test image's sets, metres and radians, for each threshold."""
    dof = Chart(calibration.pose.rotation).dof
    lines = ["", f"{'width, self-test':<18}" + "".join(f"{name:>10}" for name in dof)]
    sets = selftest_sets(calibration, head, calibration.thresholds)
    for entry, found in zip(calibration.thresholds, sets, strict=True):
        width = found.width()
        if np.isfinite(width).any():
            cells = "".join(f"{'unbounded' if w == np.inf else _number(w):>10}" for w in width)
            lines.append(f"{f'{entry.confidence:g} {entry.scope}':<18}" + cells)
    return lines


def _contradiction(calibration: Calibration, head: Head) -> list[str]:
    try:
        check_plausible(calibration, head)
    except CalibrationFileError as error:
        return ["", *_entry("refused", f"by verify: {error}")]
    return []


def _proven(calibration: Calibration, head: Head) -> list[str]:
    """Say what is proven at each level, or what an unbounded one needs."""
    source = calibration.calibration
    levels = by_level(
        (entry.confidence, entry.scope, statement(source, head, entry))
        for entry in calibration.thresholds
    )
    lines = []
    for level, text in levels:
        label = "unbounded" if text.startswith("unbounded") else "proven"
        lines += _entry(label, f"at {level}: {text.removeprefix('unbounded; ')}")
    return lines


def _left_out(calibration: Calibration) -> list[str]:
    """Give the coverage of each recording by thresholds from the others, where it is stored."""
    found = [
        left_out_text(entry.scope, entry.left_out)
        for entry in calibration.thresholds
        if entry.left_out is not None and entry.confidence == _SHOWN
    ]
    if not found:
        return []
    text = f"coverage of a recording left out, at {_SHOWN:g}: {', '.join(found)}"
    return _entry("measured", text)


def _rule(source: CalibrationSpec) -> str:
    return source.rule if source.cap is None else f"{source.rule} at {source.cap:g}"


def _worth(source: CalibrationSpec) -> str:
    """Return the effective sample size, except for a random split, which hides dependence."""
    if source.split.kind == "random":
        return ""
    return f"; worth about {source.n_effective:.0f} independent frames"


def _crossed(source: CalibrationSpec) -> list[str]:
    """Say how a crossed calibration was made and what it does not prove."""
    if source.crossed is None:
        return []
    return _entry(
        "crossed",
        f"in {source.crossed} folds: the scores of each come from a network trained without its "
        "recordings, this network was trained on all of them: its coverage is measured, not proven",
    )


def doctor_lines(report: dict[str, Any]) -> list[str]:
    """Return a readable description of the environment."""
    versions = ", ".join(f"{name} {value}" for name, value in report["versions"].items())
    return [
        *_entry("processor", f"{report['cpu']} ({report['architecture']})"),
        *_entry("cores", f"{report['cores_allowed']} allowed of {report['cores_present']} present"),
        *_entry("governor", report["governor"] or "not readable"),
        *_entry("system", report["system"]),
        *_entry("memory", f"{report['memory_available_mib']:.0f} MiB available"),
        *_entry("load", " ".join(f"{value:.2f}" for value in report["load_average"])),
        *_entry("versions", versions),
    ]


def cache_lines(cache: ModelCache) -> list[str]:
    """Return a readable list of the entries of a cache."""
    entries = cache.entries()
    lines = _entry("folder", f"{cache.folder}, {len(entries)} optimised model(s)")
    obstacle = cache.obstacle()
    if obstacle is not None:
        lines += _entry("not used", obstacle)
    for entry in entries:
        made = f"sha256 {entry.model_sha256[:16]}..., {entry.engine}"
        other = "" if entry.current else ", for another machine or release"
        lines += _entry(f"{entry.megabytes:9.1f} MB", f"{entry.name} ({made}{other})")
    return lines


def calibration_schema() -> dict[str, Any]:
    """Return the JSON Schema of ``calibration.json``, with each method's own parameters."""
    parameters = [head.parameters_type for head in HEADS.values()]
    (document, *own), components = msgspec.json.schema_components(
        [Calibration, *parameters], ref_template="#/$defs/{name}"
    )
    properties = components["Calibration"]["properties"]
    properties["method"] = {"enum": list(HEADS)}
    properties["method_parameters"] = {"anyOf": own}
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        **document,
        "$defs": components,
    }


def motion_schema() -> dict[str, Any]:
    """Return the JSON Schema of ``motion.json``."""
    from cvo_edge.motion.format import MotionFile

    (document,), components = msgspec.json.schema_components(
        [MotionFile], ref_template="#/$defs/{name}"
    )
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        **document,
        "$defs": components,
    }


def _number(value: float) -> str:
    """Return a number in at most nine characters, so that columns stay apart."""
    return f"{value:.5f}" if value < 999.5 else f"{value:.6g}"
