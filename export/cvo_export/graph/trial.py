"""Try a network on a few frames; if it is hardly better than their mean pose, try other forms.

A wrong quaternion order, direction, unit, channel order or range makes a good network look bad. The
forms of its outputs are compared without running it again. Nothing is applied: the forms that would
fit are named, and whoever knows the network decides.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import product
from typing import Any, NamedTuple

import numpy as np
import onnx
import onnxruntime
from numpy.typing import NDArray

from cvo_edge.engine.session import one_line
from cvo_edge.errors import ModelError, SourceError
from cvo_edge.input import preprocess
from cvo_edge.pose import about
from cvo_edge.vocabulary import Crop
from cvo_export.data.pose_errors import MedianError, mean_pose_error, median_error
from cvo_export.datasets import PoseDataset
from cvo_export.graph.adapt import image_before, pose_behind
from cvo_export.graph.adapt_options import InputForm, OutputForm, input_text, output_text

Array = NDArray[np.float64]
Outputs = Mapping[str, OutputForm]

_FRAMES = 24
# Errors as shares of the mean pose's. From the first on, other forms are tried: where a camera
# turns round, a wrong rotation is as good as the mean one. A form fits if its shares are this small
# on average, and this much smaller than those of the stated form.
_DOUBTFUL, _FITS, _GAIN = 0.5, 0.8, 0.7
# Forms whose errors are this much larger than the least are worth naming.
_NEAR = 1.25
_NAMED = 3
_IMAGENET = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
_RANGES: tuple[tuple[str, tuple[float, ...] | None, tuple[float, ...] | None], ...] = (
    ("0-1", None, None),
    ("0-255", None, None),
    ("0-1", *_IMAGENET),
    ("0-1", (0.5,), (0.5,)),
)
_SIZES = ((224, 224), (240, 320), (256, 256), (480, 640))
_FORMS = (
    ("quaternion_xyzw", "quaternion_wxyz"),
    ("rotvec", "logq"),
    ("six", "six_rows"),
    ("matrix",),
)
_NONE_FITS = (
    "no other quaternion order, direction, axes, unit, channel order, range, crop or size that was "
    "tried fits either; is it a network of this place and this world frame?"
)
# A quaternion of another length is probably none.
_NORMS = 0.5, 2.0


@dataclass(frozen=True)
class Form:
    """What is stated of a network: its input, its outputs, height and width, and the crop."""

    given: InputForm
    outputs: Outputs
    size: tuple[int, int] | None
    crop: Crop

    @property
    def _features(self) -> tuple[object, ...]:
        """What a network's author may have chosen otherwise, one by one."""
        given, outputs = self.given, self.outputs
        placed = outputs.get("pose", outputs.get("translation"))
        turned = outputs.get("pose", outputs.get("rotation"))
        return (
            *(given.order, (given.range, given.mean, given.std), self.size, self.crop),
            placed and placed.unit,
            *((turned.form, turned.direction, turned.axes) if turned else ()),
        )

    def changes(self, other: Form) -> int:
        """Count in how many ways another form differs."""
        return sum(a != b for a, b in zip(self._features, other._features, strict=True))

    def options(self, other: Form, stated: bool) -> str:
        """Return the options that turn this form into another; all outputs if none is stated."""
        texts = []
        if other.given != self.given:
            texts.append(f"--input {input_text(other.given)}")
        texts += [
            f"--output {output_text(role, form)}"
            for role, form in other.outputs.items()
            if not stated or form != self.outputs[role]
        ]
        if other.size != self.size and other.size is not None:
            texts.append(f"--size {other.size[0]}x{other.size[1]}")
        if other.crop != self.crop:
            texts.append(f"--crop {other.crop}")
        return " ".join(texts)


class Tried(NamedTuple):
    """A form, its error on the frames, and both errors as shares of the mean pose's."""

    form: Form
    error: MedianError
    shares: tuple[float, float]

    @property
    def score(self) -> float:
        """Mean of both shares."""
        return sum(self.shares) / 2


def tried(
    model: onnx.ModelProto,
    form: Form,
    dataset: PoseDataset,
    indices: NDArray[np.int64],
    origin_m: Sequence[float] | None,
    stated: bool,
) -> list[str]:
    """Return what to say of the network's errors on some of these frames; nothing if it is good.

    ``stated`` tells whether the outputs were stated by options. Poses are compared relative to
    ``origin_m``, as the network gives them.
    """
    chosen = indices[np.linspace(0, indices.size - 1, min(_FRAMES, indices.size)).astype(int)]
    read = [(index, image) for index in chosen.tolist() for image in _image(dataset, index)]
    if not read:
        return []
    images = [image for _, image in read]
    truth = about(dataset.poses[[index for index, _ in read]], origin_m)
    mean = mean_pose_error(truth)

    def try_on(forms: Sequence[Form]) -> Iterator[Tried]:
        """Run the network once for forms that differ in their outputs alone."""
        own = _run(model, forms[0], images)
        for each in forms:
            error = median_error(_poses(own, each.outputs), truth)
            yield Tried(each, error, error.shares(mean))

    (now,) = try_on([form])
    if max(now.shares) < _DOUBTFUL:
        return []
    found = [each for given in _inputs(form.given) for each in try_on(_readings(form, given))]
    best = min(found, key=lambda each: each.score, default=now)
    for size, crop in _views(best.form, images[0].shape[:2]):
        viewed = replace(best.form, size=size, crop=crop)
        # A network may run at its own size alone.
        with contextlib.suppress(ModelError):
            found += try_on(_readings(viewed, best.form.given))
    named = _named(form, now, found, stated)
    if max(now.shares) < 1.0:
        return named
    return [
        f"warning: the network is no better than the mean pose of {len(read)} frames of val: "
        f"median error {now.error}, of the mean pose {mean}{_length_text(model, form, images)}",
        *(named or [_NONE_FITS]),
    ]


def _named(form: Form, now: Tried, found: Sequence[Tried], stated: bool) -> list[str]:
    """Return a line for each form that fits with the fewest changes."""
    limit = min(_FITS, _GAIN * now.score)
    fits = [each for each in found if max(each.shares) < 1.0 and each.score < limit]
    least = min((each.score for each in fits), default=0.0)
    near = [each for each in fits if each.score <= _NEAR * least]
    fewest = min((form.changes(each.form) for each in near), default=0)
    near = [each for each in near if form.changes(each.form) == fewest]
    near.sort(key=lambda each: each.score)
    return [
        f"with {form.options(each.form, stated)} the median error would be {each.error} instead of "
        f"{now.error}"
        for each in near[:_NAMED]
    ]


def _image(dataset: PoseDataset, index: int) -> Iterator[NDArray[np.uint8]]:
    try:
        image = preprocess.to_bgr8(dataset.read_image(index))
    except SourceError:
        return  # counted when all frames are observed
    if image is not None:
        yield image


def _run(
    model: onnx.ModelProto, form: Form, images: Sequence[NDArray[np.uint8]]
) -> list[dict[str, NDArray[Any]]]:
    """Return the network's own outputs for each image; raises ModelError if it does not run."""
    names = sorted({each.name for each in form.outputs.values()})
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4
    content, prefix, (height, width) = image_before(model, form.given, form.size)
    own = []
    try:
        engine = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
        for image in images:
            tensor = preprocess.model_input(image, height, width, form.crop)
            values = engine.run([prefix + name for name in names], {"image": tensor})
            own.append(dict(zip(names, values, strict=True)))
    # onnxruntime raises a dozen unrelated types here.
    except Exception as error:  # noqa: BLE001
        raise ModelError(f"model: does not run at {height}x{width}: {one_line(error)}") from None
    return own


def _poses(own: Sequence[Mapping[str, NDArray[Any]]], outputs: Outputs) -> Array:
    """Return poses (n, 7) with unit quaternions of the network's own outputs, read in one form."""
    poses = _read(own, outputs)
    with np.errstate(invalid="ignore", divide="ignore"):
        poses[:, 3:] /= np.linalg.norm(poses[:, 3:], axis=1, keepdims=True)
    return poses


def _read(own: Sequence[Mapping[str, NDArray[Any]]], outputs: Outputs) -> Array:
    of_pose = {role: each for role, each in outputs.items() if role not in ("lower", "upper")}
    shapes = {name: values.shape for name, values in own[0].items()}
    engine, ports = _reader(tuple(of_pose.items()), tuple(shapes.items()))
    rows = [
        engine.run(None, {port: np.float32(each[name]) for name, port in ports.items()})[0][0]
        for each in own
    ]
    return np.array(rows, np.float64)


@lru_cache(maxsize=32)
def _reader(
    outputs: tuple[tuple[str, OutputForm], ...], shapes: tuple[tuple[str, tuple[int, ...]], ...]
) -> tuple[onnxruntime.InferenceSession, dict[str, str]]:
    """Return the graph that reads outputs of these shapes; every input is read in every form."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    content, ports = pose_behind(dict(outputs), dict(shapes))
    providers = ["CPUExecutionProvider"]
    return onnxruntime.InferenceSession(content, options, providers=providers), ports


def _length_text(model: onnx.ModelProto, form: Form, images: Sequence[NDArray[np.uint8]]) -> str:
    """Say if what is read as a quaternion is none."""
    own = _run(model, form, images[:1])
    (turn,) = [each for role, each in form.outputs.items() if role in ("pose", "rotation")]
    if not turn.form.startswith("quaternion"):
        return ""
    length = float(np.linalg.norm(_read(own, form.outputs)[0, 3:]))
    if _NORMS[0] <= length <= _NORMS[1]:
        return ""
    return f"; the quaternion in {turn.name} has the length {length:.3g}: is it one?"


def _inputs(given: InputForm) -> Iterator[InputForm]:
    """Yield other orders and ranges; a graph without a range normalises by itself."""
    ranges = [(given.range, given.mean, given.std)]
    if given.range is not None:
        ranges += [each for each in _RANGES if each not in ranges]
    for order, (scale, mean, std) in product(("rgb", "bgr"), ranges):
        yield replace(given, order=order, range=scale, mean=mean, std=std)


def _readings(form: Form, given: InputForm) -> list[Form]:
    """Return a form with every other meaning of its outputs."""
    roles = {role: each for role, each in form.outputs.items() if role not in ("lower", "upper")}
    turn = roles.get("pose", roles.get("rotation", OutputForm("")))
    forms = next(each for each in _FORMS if turn.form in each)
    units, directions, axes = ("m", "cm", "mm"), ("camera_to_world", "world_to_camera"), _AXES
    found = []
    for rotation, unit, direction, axis in product(forms, units, directions, axes):
        outputs = dict(form.outputs)
        for role in roles:
            changed = outputs[role]
            if role in ("pose", "translation"):
                changed = replace(changed, unit=unit)
            if role in ("pose", "rotation"):
                changed = replace(changed, form=rotation, direction=direction, axes=axis)
            outputs[role] = changed
        found.append(replace(form, given=given, outputs=outputs))
    return found


_AXES = ("opencv", "opengl")


def _views(form: Form, image: tuple[int, int]) -> Iterator[tuple[tuple[int, int] | None, Crop]]:
    """Yield other sizes, if the size was stated, and the other crop."""
    crops: tuple[Crop, ...] = ("none", "centre")
    shapes = [form.size]
    if form.size is not None:
        shapes += [each for each in (image, *_SIZES) if each != form.size]
    for size, crop in product(shapes, crops):
        if (size, crop) != (form.size, form.crop):
            yield size, crop
