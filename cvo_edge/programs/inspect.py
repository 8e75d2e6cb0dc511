"""What a person asks of a bundle or a machine, as lines of text, and the JSON Schema."""

from __future__ import annotations

import math
from typing import Any

import msgspec

from cvo_edge.bundle.format import Calibration, CalibrationSpec
from cvo_edge.engine.model_cache import ModelCache
from cvo_edge.heads import HEADS, Head
from cvo_edge.heads.checked import checked_head
from cvo_edge.pose import Chart


def inspect_lines(calibration: Calibration) -> list[str]:
    """Return a bundle's description for a person; raises as ``checked_head``."""
    model, source = calibration.model, calibration.calibration
    pose, head = calibration.pose, checked_head(calibration)
    details = f", {head.description()}" if head.description() else ""
    tensors = ", ".join(f"{t.name} {list(t.shape)}" for t in (*model.inputs, *model.outputs))
    dof = Chart(pose.rotation).dof
    lines = [
        f"name         {calibration.name}",
        f"method       {calibration.method}, {source.score} score{details}",
        f"model        {model.precision}, opset {model.opset}, sha256 {model.sha256[:16]}..., "
        f"on {model.provider}",
        f"tensors      {tensors}",
        f"pose         {pose.target}, {pose.child_frame_id} in {pose.frame_id}, {pose.rotation}",
        f"calibrated   on {source.n} frames of {source.n_sequences} sequence(s) of "
        f"{source.dataset}, split {source.split.kind} (seed {source.split.seed}), {source.rule}"
        + _worth(source),
        f"joint        by {head.joint_description(source.joint)}",
        f"backbone     {calibration.provenance.backbone or 'a given network'}",
        "",
        f"{'q_hat at':<16}" + "".join(f"{name:>11}" for name in dof),
    ]
    for entry in calibration.thresholds:
        sides = [("", entry.q_hat)]
        if entry.q_hat_upper is not None:
            sides = [(" low", entry.q_hat), (" high", entry.q_hat_upper)]
        for side, values in sides:
            cells = "".join(f"{'unbounded' if v is None else f'{v:.5f}':>11}" for v in values)
            lines.append(f"{f'{entry.confidence:g} {entry.scope}{side}':<16}" + cells)
    return lines + _unbounded(calibration, head)


def _unbounded(calibration: Calibration, head: Head) -> list[str]:
    """Say why thresholds are unbounded: how many frames or sequences they would need."""
    source = calibration.calibration
    unit, given = ("frames", source.n)
    if source.rule == "hierarchical":
        unit, given = ("sequences", source.n_sequences)
    lines = []
    for entry in calibration.thresholds:
        levels = head.side_confidences(entry.confidence)
        if entry.scope == "joint" and source.joint == "bonferroni":
            levels = head.side_confidences(1.0 - (1.0 - entry.confidence) / 6)
        sides = [
            (level, q_hat)
            for level, q_hat in zip(levels, (entry.q_hat, entry.q_hat_upper), strict=False)
            if level is not None and q_hat is not None and None in q_hat
        ]
        if not sides:
            continue
        level = max(level for level, _ in sides)
        if entry.scope == "joint" and source.joint == "max":
            level = entry.confidence
        needed = math.ceil(level / (1.0 - level) - 1e-9)
        reason = f"needs at least {needed} calibration {unit}, has {given}"
        if given >= needed:
            reason = head.infinite_score
        lines.append(f"unbounded    at {entry.confidence:g} {entry.scope}: {reason}")
    return lines


def _worth(source: CalibrationSpec) -> str:
    """Remark that frames of one recording are dependent; a random split deals that away."""
    if source.split.kind == "random":
        return ""
    return f"; worth about {source.n_effective:.0f} independent frames"


def doctor_lines(report: dict[str, Any]) -> list[str]:
    """Return the environment for a person."""
    versions = ", ".join(f"{name} {value}" for name, value in report["versions"].items())
    return [
        f"processor    {report['cpu']} ({report['architecture']})",
        f"cores        {report['cores_allowed']} allowed of {report['cores_present']} present",
        f"governor     {report['governor'] or 'not readable'}",
        f"system       {report['system']}",
        f"memory       {report['memory_available_mib']:.0f} MiB available",
        f"load         {' '.join(f'{value:.2f}' for value in report['load_average'])}",
        f"versions     {versions}",
    ]


def cache_lines(cache: ModelCache) -> list[str]:
    """Return what a cache holds for a person."""
    entries = cache.entries()
    lines = [f"folder       {cache.folder}, {len(entries)} prepared model(s)"]
    obstacle = cache.obstacle()
    if obstacle is not None:
        lines.append(f"not used     {obstacle}")
    for entry in entries:
        made = f"sha256 {entry.model_sha256[:16]}..., onnxruntime {entry.onnxruntime}"
        other = "" if entry.current else ", of another machine or release"
        lines.append(f"{entry.megabytes:9.1f} MB {entry.name} ({made}{other})")
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
