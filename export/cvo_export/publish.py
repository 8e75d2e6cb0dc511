"""A run folder -> a bundle: export, parity, calibration, self-test, written whole or not at all."""

from __future__ import annotations

import hashlib
import importlib.metadata
import shutil
import tempfile
from collections.abc import Mapping
from pathlib import Path

import msgspec
import numpy as np
import torch
from numpy.typing import NDArray

from cvo_edge import artifact, preprocess
from cvo_edge.artifact import CONFIDENCES, Bundle, Calibration, Threshold
from cvo_edge.conformal import conformal_quantile, interval_score
from cvo_edge.errors import SinkError
from cvo_edge.heads.cjp import CjpHead, CjpParameters
from cvo_edge.odometer import Odometer
from cvo_edge.selftest import check_selftest, observe_selftest
from cvo_edge.session import Session
from cvo_export.calibrate import Observed, Rule, effective_frames, observe, thresholds
from cvo_export.run import Run
from cvo_export.to_onnx import OPSET, check_parity, export_onnx

Array = NDArray[np.float64]

WORLD_FRAME, CAMERA_FRAME = "world", "camera"
SELFTEST_TOLERANCE = 1e-3
# Of another shape than any camera and model, so that resize and crop are tested, too.
_SELFTEST_SIZE = (418, 650)

# How far beyond the training poses a pose is still plausible, in ranges of each DoF.
_LIMIT_MARGIN = 0.5
# Least half-width in the normalised score, in standard deviations of each DoF.
_FLOOR = 0.01
# What the additive score has to win on val by: smaller differences there are chance.
_CLEARLY = 0.05


def publish(run: Run, bundle_dir: Path, name: str, rule: Rule | None = None) -> Calibration:
    """Export and calibrate a finished run and write its bundle; returns the calibration.

    ``rule`` None is ``hierarchical`` for a run split by sequence, else ``pooled``.

    Raises
    ------
    GateError
        torch and onnxruntime disagree, or the written bundle fails its own self-test.
    SinkError
        The folder cannot be written, or holds something that is no bundle.
    """
    _check_target(bundle_dir)
    if rule is None:
        rule = "hierarchical" if run.split.kind == "sequence" else "pooled"
    model_bytes, parity = _export(run)
    draft = _draft(run, model_bytes, name, rule, parity)
    split = run.split.roles
    with Odometer(Bundle(draft, model_bytes)) as odometer:
        val = observe(odometer, run.dataset, split["val"])
        cal = observe(odometer, run.dataset, split["cal"])
        selftest = msgspec.structs.replace(
            draft.selftest,
            outputs={
                output: tuple(float(f"{value:.9g}") for value in values.reshape(-1).tolist())
                for output, values in observe_selftest(odometer).outputs.items()
            },
        )
    score = _better_score(draft, val, run.target.std)
    scored = msgspec.structs.replace(
        draft, calibration=msgspec.structs.replace(draft.calibration, score=score)
    )
    head = CjpHead(scored)
    cal_scores = head.scores(cal.outputs, cal.point, cal.truth)
    val_scores = head.scores(val.outputs, val.point, val.truth)
    calibration = msgspec.structs.replace(
        scored,
        thresholds=thresholds(cal_scores, cal.sequence, val_scores, rule),
        selftest=selftest,
        calibration=msgspec.structs.replace(
            scored.calibration,
            n=len(cal.indices),
            n_sequences=len(np.unique(cal.sequence)),
            n_effective=round(effective_frames(cal_scores, cal.sequence), 1),
        ),
    )
    _write_bundle(bundle_dir, calibration, model_bytes)
    return artifact.read_calibration(bundle_dir)


def _export(run: Run) -> tuple[bytes, float]:
    """Model bytes, and the largest difference between torch and onnxruntime on test images."""
    config = run.config
    names = ["image"]
    image = torch.zeros((1, config.height, config.width, 3), dtype=torch.uint8)
    inputs = [image]
    if config.head.latent == "sample":
        names.append("latent_noise")
        inputs.append(torch.zeros((1, config.head.latent_size)))
    content = export_onnx(run.graph, inputs, names, ["pose", "lower", "upper"])
    generator = np.random.default_rng(0)
    feeds = []
    for index in run.split.roles["val"][:32]:
        bgr = run.dataset.read_image(int(index))
        feed: dict[str, NDArray[np.generic]] = {
            "image": preprocess.model_input(bgr, config.height, config.width, config.crop)
        }
        if len(names) > 1:
            noise = generator.standard_normal((1, config.head.latent_size))
            feed["latent_noise"] = noise.astype(np.float32)
        feeds.append(feed)
    return content, check_parity(run.graph, Session(content), feeds, names)


def _draft(run: Run, model_bytes: bytes, name: str, rule: Rule, parity: float) -> Calibration:
    """Everything but scores: unbounded thresholds, an empty self-test, the additive score."""
    config, target = run.config, run.target
    session = Session(model_bytes)
    roles = run.split.roles
    training = np.concatenate([roles["train"], roles["fit"]])
    coordinates = target.coordinates(run.dataset.poses[training])
    lowest, highest = coordinates.min(axis=0), coordinates.max(axis=0)
    margin = _LIMIT_MARGIN * (highest - lowest)
    unbounded = tuple(
        Threshold(confidence=c, scope="marginal", q_hat=(None,) * 6, q_hat_upper=None)
        for c in CONFIDENCES
    )
    parameters = CjpParameters(
        half_width_floor=_six(_FLOOR * target.std),
        latent=config.head.latent,
        latent_size=config.head.latent_size,
        noise_seed=config.seed,
    )
    height, width = _SELFTEST_SIZE
    return Calibration(
        schema_version=1,
        name=name,
        method="cjp",
        model=artifact.ModelSpec(
            file=artifact.MODEL_FILE,
            sha256=hashlib.sha256(model_bytes).hexdigest(),
            opset=OPSET,
            precision="fp32",
            inputs=session.inputs,
            outputs=session.outputs,
        ),
        preprocess=artifact.PreprocessSpec(
            height=config.height,
            width=config.width,
            colour_order="rgb",
            interpolation="halve_then_linear_exact",
            crop=config.crop,
            mean=_three(run.graph.backbone.mean),
            std=_three(run.graph.backbone.std),
            layout="nhwc",
            in_graph=("cast", "transpose", "normalise"),
        ),
        pose=artifact.PoseSpec(
            target="absolute",
            frame_id=WORLD_FRAME,
            child_frame_id=CAMERA_FRAME,
            rotation="tangent_reference",
            reference_q_xyzw=_four(target.reference_q_xyzw),
            units=("m", "rad"),
            limits=artifact.PoseLimits(
                lowest=_six(lowest - margin), highest=_six(highest + margin)
            ),
            standard_deviation=_six(target.std),
        ),
        thresholds=unbounded,
        method_parameters=msgspec.to_builtins(parameters),
        calibration=artifact.CalibrationSpec(
            score="additive",
            rule=rule,
            n=1,
            n_sequences=1,
            n_effective=1.0,
            split=artifact.SplitSpec(
                kind=run.split.kind, seed=run.split.seed, sha256=run.split.digest(run.dataset)
            ),
            dataset=run.dataset.name,
        ),
        selftest=artifact.SelfTest(
            recipe="ripples-1",
            height=height,
            width=width,
            outputs={},
            tolerance=SELFTEST_TOLERANCE,
        ),
        provenance=artifact.Provenance(
            created_with=_versions(),
            seed=config.seed,
            backbone=config.backbone.name,
            weights_sha256=run.weights_sha256,
            dataset=run.dataset.name,
            options={**_options(run), "parity": float(f"{parity:.3g}")},
        ),
        digest="0" * 64,
    )


def _better_score(draft: Calibration, val: Observed, std: Array) -> str:
    """Return ``additive`` only where its sets on val, thresholded there, are clearly the better.

    In a near tie the normalised score stands: its thresholds are factors, which carry over to
    recordings that are harder or easier as a whole.
    """
    results = {}
    for name in ("additive", "normalised"):
        calibration = msgspec.structs.replace(
            draft, calibration=msgspec.structs.replace(draft.calibration, score=name)
        )
        head = CjpHead(calibration)
        scores = head.scores(val.outputs, val.point, val.truth)
        q_hat = _six(np.array([conformal_quantile(scores[:, dof], 0.9) for dof in range(6)]))
        entry = Threshold(confidence=0.9, scope="marginal", q_hat=q_hat, q_hat_upper=None)
        sets = [
            head.region({k: v[row : row + 1] for k, v in val.outputs.items()}, point, entry)
            for row, point in enumerate(val.point)
        ]
        width = np.array([region.width() for region in sets])
        distance = np.array([r.distance(y) for r, y in zip(sets, val.truth, strict=True)])
        results[name] = float((interval_score(width, distance, 0.1) / std).mean())
    clearly = results["additive"] < (1.0 - _CLEARLY) * results["normalised"]
    return "additive" if clearly else "normalised"


def _options(run: Run) -> Mapping[str, str | int | float | bool | None]:
    """Flatten the run's configuration; data set and weights are named elsewhere, without paths."""
    flat: dict[str, str | int | float | bool | None] = {}

    def add(prefix: str, values: Mapping[str, object]) -> None:
        for key, value in values.items():
            if key in ("dataset", "weights", "method", "seed"):
                continue
            if isinstance(value, Mapping):
                add(f"{key}.", value)
            elif isinstance(value, list | tuple):
                flat[prefix + key] = "x".join(str(item) for item in value)
            elif isinstance(value, str | int | float | bool | None):
                flat[prefix + key] = value

    add("", msgspec.to_builtins(run.config))
    return flat


def _versions() -> dict[str, str]:
    packages = ("cvo-edge", "cvo-export", "torch", "timm", "onnx", "onnxruntime", "numpy")
    return {package: importlib.metadata.version(package) for package in packages}


def _check_target(bundle_dir: Path) -> None:
    own = {artifact.CALIBRATION_FILE, artifact.MODEL_FILE}
    if bundle_dir.exists() and not (
        bundle_dir.is_dir() and {path.name for path in bundle_dir.iterdir()} == own
    ):
        raise SinkError(
            f"{bundle_dir}: expected a new folder or a bundle to replace, found another"
        )


def _write_bundle(bundle_dir: Path, calibration: Calibration, model_bytes: bytes) -> None:
    """Write beside the target, verify by reading and self-test, then move into place."""
    content = artifact.encode_calibration(calibration)
    parent = bundle_dir.resolve().parent
    try:
        parent.mkdir(parents=True, exist_ok=True)
        partial = Path(tempfile.mkdtemp(prefix=f".{bundle_dir.name}.", dir=parent))
    except OSError as error:
        raise SinkError(f"{parent}: cannot be written: {error.strerror}") from None
    try:
        partial.chmod(0o755)
        (partial / artifact.MODEL_FILE).write_bytes(model_bytes)
        (partial / artifact.CALIBRATION_FILE).write_bytes(content)
        with Odometer.load(partial) as odometer:
            check_selftest(odometer)
        replaced = None
        if bundle_dir.exists():
            replaced = Path(tempfile.mkdtemp(prefix=f".{bundle_dir.name}.", dir=parent)) / "old"
            bundle_dir.rename(replaced)
        partial.rename(bundle_dir)
        if replaced is not None:
            shutil.rmtree(replaced.parent)
    except OSError as error:
        raise SinkError(f"{bundle_dir}: cannot be written: {error.strerror}") from None
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _six(values: Array) -> artifact.Six:
    a, b, c, d, e, f = (float(value) for value in values)
    return (a, b, c, d, e, f)


def _four(values: Array) -> artifact.Quaternion:
    x, y, z, w = (float(value) for value in values)
    return (x, y, z, w)


def _three(values: list[float]) -> tuple[float, float, float]:
    a, b, c = values
    return (a, b, c)
