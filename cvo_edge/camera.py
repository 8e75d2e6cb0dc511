"""A calibrated camera: image pixels <-> rays in the camera frame.

Pixel centres have integer coordinates; the camera frame has x right, y down and z forward. A ray is
given by its normalised coordinates (x/z, y/z).
"""

from __future__ import annotations

import math
import os
import re
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import numpy as np
from msgspec import Meta, Struct
from msgspec.structs import replace
from numpy.typing import ArrayLike, NDArray

from cvo_edge.errors import UsageError
from cvo_edge.files import read_regular_file
from cvo_edge.given import given_path

Array = NDArray[np.float64]

Distortion = Literal["none", "radial_tangential", "equidistant"]
_Pixels = Annotated[int, Meta(ge=1, le=100_000)]
_Number = Annotated[float, Meta(gt=-1e6, lt=1e6)]
_Focal = Annotated[float, Meta(gt=0, lt=1e6)]

# Numbers that each model takes: k1 k2 p1 p2 (k3 (k4 k5 k6)) as in OpenCV, and k1 k2 k3 k4.
_COUNTS: dict[Distortion, tuple[int, ...]] = {
    "none": (0,),
    "radial_tangential": (4, 5, 8),
    "equidistant": (4,),
}
# Newton's method needs 4 to 8 steps; a pixel beyond the model's range never converges.
_STEPS = 50
_CONVERGED = 1e-9
# Places between the optical axis and a ray where the lens must not turn the image back.
_ALONG = 33
# Smallest side of an image, largest camera file.
LEAST_SIDE, _LARGEST_FILE = 16, 64 * 1024
# A camera in one word, as ``--camera`` takes it.
_SHORT = re.compile(
    r"(?P<width>\d+)x(?P<height>\d+),(?P<fx>[^,]+),(?P<fy>[^,]+),(?P<cx>[^,]+),(?P<cy>[^,]+)"
)
# Values of a sensor.yaml of the ASL layout (Burri et al. 2016): words, or lists of numbers.
_YAML_VALUE = re.compile(r"^(\w+):[ \t]*([^\[\s]+|\[[^\]]*\])[ \t]*$", re.MULTILINE)
_YAML_MODELS: dict[str | None, Distortion] = {
    "radial-tangential": "radial_tangential",
    "radtan": "radial_tangential",
    "equidistant": "equidistant",
}
# Wider pinhole images exist in files with a mistake only.
_WIDEST_DEG = 170.0


class Camera(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, omit_defaults=True):
    """Intrinsics of a camera.

    ``width`` and ``height`` are the size of its images, ``fx fy cx cy`` focal lengths and principal
    point, all in pixels. ``distortion``: ``radial_tangential`` (Brown and Conrady; OpenCV's order
    k1 k2 p1 p2 [k3 [k4 k5 k6]]) or ``equidistant`` (Kannala and Brandt 2006; k1 k2 k3 k4, OpenCV's
    fisheye model), with its ``coefficients``.
    """

    width: _Pixels
    height: _Pixels
    fx: _Focal
    fy: _Focal
    cx: _Number
    cy: _Number
    distortion: Distortion = "none"
    coefficients: tuple[_Number, ...] = ()

    def __post_init__(self) -> None:
        """Raise ValueError if the distortion model does not take this many coefficients."""
        counts = _COUNTS[self.distortion]
        if len(self.coefficients) not in counts:
            raise ValueError(
                f"expected {' or '.join(map(str, counts))} coefficients for distortion "
                f"{self.distortion}, found {len(self.coefficients)}"
            )

    def scaled(self, width: int, height: int) -> Camera:
        """Return the same camera for its images resized to another width and height."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self,
            width=width,
            height=height,
            fx=sx * self.fx,
            fy=sy * self.fy,
            # The left edge of the image is half a pixel left of the first pixel's centre.
            cx=sx * (self.cx + 0.5) - 0.5,
            cy=sy * (self.cy + 0.5) - 0.5,
        )

    def zoomed(self, factor: float) -> Camera:
        """Return a camera of the same size and lens with ``factor`` times the focal length."""
        return replace(self, fx=factor * self.fx, fy=factor * self.fy)

    @property
    def focal_px(self) -> float:
        """Geometric mean of both focal lengths, pixels."""
        return math.sqrt(self.fx * self.fy)

    @property
    def matrix(self) -> Array:
        """The camera matrix K (3, 3), which maps rays to pixels if there is no distortion."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def cropped(self, top: int, bottom: int, left: int, right: int) -> Camera:
        """Return the camera that sees the rows top to bottom and columns left to right only."""
        width, height = right - left, bottom - top
        return replace(self, width=width, height=height, cx=self.cx - left, cy=self.cy - top)

    def rays(self, pixels: ArrayLike) -> Array:
        """Pixels (n, 2) -> rays (n, 2); NaN where no ray of the lens model meets a pixel."""
        values = np.asarray(pixels, dtype=np.float64)
        distorted = (values - (self.cx, self.cy)) / (self.fx, self.fy)
        if self.distortion == "none":
            return distorted
        rays = distorted.copy()
        with np.errstate(all="ignore"):
            for _ in range(_STEPS):
                found, jacobian = self._distorted(rays)
                rays = rays + _solved(jacobian, distorted - found)
            found, _ = self._distorted(rays)
            right = np.abs(found - distorted).max(axis=-1) < _CONVERGED
            # Beyond the angle where the image turns back, another ray has the same pixel.
            for share in np.linspace(0.0, 1.0, _ALONG):
                _, jacobian = self._distorted(share * rays)
                right &= _determinant(jacobian) > 0.0
        rays[~right] = np.nan
        return rays

    def project(self, points: ArrayLike) -> Array:
        """Points in the camera frame (n, 3) with positive z -> pixels (n, 2)."""
        p = np.asarray(points, dtype=np.float64)
        rays = p[..., :2] / p[..., 2:]
        if self.distortion != "none":
            rays, _ = self._distorted(rays)
        return np.asarray(rays * (self.fx, self.fy) + (self.cx, self.cy))

    def _distorted(self, rays: Array) -> tuple[Array, Array]:
        """Rays (n, 2) -> where the lens images them (n, 2), and the Jacobian (n, 2, 2)."""
        x, y = rays[..., 0], rays[..., 1]
        r2 = x * x + y * y
        if self.distortion == "equidistant":
            return _equidistant(rays, r2, self.coefficients)
        k1, k2, p1, p2, k3, k4, k5, k6 = (*self.coefficients, *[0.0] * 8)[:8]
        upper = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        lower = 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6))
        radial = upper / lower
        # The derivative by r^2.
        slope = (
            k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3) - radial * (k4 + r2 * (2.0 * k5 + 3.0 * r2 * k6))
        ) / lower
        found = np.stack(
            [
                x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
                y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
            ],
            axis=-1,
        )
        cross = 2.0 * (x * y * slope + p1 * x + p2 * y)
        jacobian = np.stack(
            [
                radial + 2.0 * x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x,
                cross,
                cross,
                radial + 2.0 * y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x,
            ],
            axis=-1,
        )
        return found, jacobian.reshape(*rays.shape, 2)


def read_camera(given: str | os.PathLike[str]) -> Camera:
    """Read a camera from a JSON file with the fields of ``Camera``, or from a short text.

    The text is ``WIDTHxHEIGHT,FX,FY,CX,CY``. A file ``*.yaml`` is a ``sensor.yaml`` of the ASL
    layout, as EuRoC has it. Raises UsageError.
    """
    path = given_path(given, "camera")
    short = _SHORT.fullmatch(str(given))
    if short is not None and not path.exists():
        try:
            return msgspec.convert(short.groupdict(), Camera, strict=False)
        except msgspec.ValidationError as error:
            raise UsageError(
                f"camera: expected WIDTHxHEIGHT,FX,FY,CX,CY in pixels, found {given}: {error}"
            ) from None
    if not os.path.lexists(path) or given == "":
        raise UsageError(
            f"camera: expected WIDTHxHEIGHT,FX,FY,CX,CY or a JSON file, found {given}: no such file"
        )
    content = read_regular_file(path, _LARGEST_FILE, UsageError, links=True)
    if path.suffix.lower() in (".yaml", ".yml"):
        return _from_sensor_yaml(path, content.decode("utf-8", "replace"))
    try:
        return msgspec.json.decode(content, type=Camera)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        form = '{"width": 640, "height": 480, "fx": 585.0, "fy": 585.0, "cx": 320.0, "cy": 240.0}'
        raise UsageError(f"{path}: expected JSON such as {form}, found: {error}") from None


def _from_sensor_yaml(path: Path, text: str) -> Camera:
    values = dict(_YAML_VALUE.findall(re.sub("#.*", "", text)))
    try:
        width, height = map(int, _listed(values["resolution"]))
        fx, fy, cx, cy = map(float, _listed(values["intrinsics"]))
        coefficients = tuple(map(float, _listed(values["distortion_coefficients"])))
        if values["camera_model"] != "pinhole":
            raise KeyError("camera_model")
        lens = {
            "distortion": _YAML_MODELS[values["distortion_model"]],
            "coefficients": coefficients,
        }
        pinhole = {"width": width, "height": height, "fx": fx, "fy": fy, "cx": cx, "cy": cy}
        return msgspec.convert(pinhole | lens, Camera)
    except (KeyError, ValueError) as error:
        found = f"none for {error}" if isinstance(error, KeyError) else str(error)
        raise UsageError(
            f"{path}: expected a sensor.yaml with resolution, camera_model pinhole, intrinsics, "
            f"distortion_model and distortion_coefficients, found {found}"
        ) from None


def _listed(text: str) -> list[str]:
    return text.strip("[]").split(",")


def checked_camera(camera: object) -> Camera:
    """Return a camera that a caller gives; raises UsageError for anything that cannot be one."""
    if not isinstance(camera, Camera):
        raise UsageError(f"camera: expected a Camera, found {type(camera).__name__}")
    try:
        given = {name: getattr(camera, name) for name in camera.__struct_fields__}
        plain = {k: v.item() if isinstance(v, np.generic) else v for k, v in given.items()}
        checked = msgspec.convert(msgspec.to_builtins(plain), Camera)
    except (msgspec.ValidationError, TypeError, ValueError, KeyError) as error:
        raise UsageError(f"camera: expected the intrinsics of a camera, found: {error}") from None
    if min(checked.width, checked.height) < LEAST_SIDE:
        raise UsageError(
            f"camera: expected images of at least {LEAST_SIDE} pixels a side, found "
            f"{checked.width}x{checked.height}"
        )
    for name, length in (("cx", checked.width), ("cy", checked.height)):
        value = getattr(checked, name)
        if not -length <= value <= 2 * length:
            raise UsageError(
                f"camera: expected {name} from {-length} to {2 * length} pixels, found {value:g}"
            )
    if checked.distortion != "equidistant":
        views = [
            2.0 * math.degrees(math.atan(0.5 * length / focal))
            for length, focal in ((checked.width, checked.fx), (checked.height, checked.fy))
        ]
        if max(views) > _WIDEST_DEG:
            raise UsageError(
                f"camera: expected a field of view of at most {_WIDEST_DEG:g} degrees without the "
                f"distortion of a fisheye, found {max(views):.1f} by {checked.width}x"
                f"{checked.height} pixels with fx {checked.fx:g} and fy {checked.fy:g}"
            )
    return checked


def cell_centres(height: int, width: int, grid: tuple[int, int]) -> Array:
    """Return the pixels (rows * columns, 2) at the centres of an image's cells, row by row."""
    rows, columns = grid
    x = (np.arange(columns) + 0.5) * (width / columns) - 0.5
    y = (np.arange(rows) + 0.5) * (height / rows) - 0.5
    return np.stack([np.tile(x, rows), np.repeat(y, columns)], axis=1)


def _determinant(jacobian: Array) -> Array:
    return np.asarray(
        jacobian[..., 0, 0] * jacobian[..., 1, 1] - jacobian[..., 0, 1] * jacobian[..., 1, 0]
    )


def _solved(jacobian: Array, y: Array) -> Array:
    """Solve (n, 2, 2) x = (n, 2) by Cramer's rule; not finite where the matrix is singular."""
    a, b, c, d = (jacobian[..., row, column] for row in (0, 1) for column in (0, 1))
    u, v = y[..., 0], y[..., 1]
    solution = np.stack([d * u - b * v, a * v - c * u], axis=-1)
    return np.asarray(solution / _determinant(jacobian)[..., np.newaxis])


def _equidistant(rays: Array, r2: Array, coefficients: tuple[float, ...]) -> tuple[Array, Array]:
    """As ``Camera._distorted``, for the angle from the optical axis (Kannala and Brandt, eq. 6)."""
    k1, k2, k3, k4 = coefficients
    # A limit of 1e-8 rad instead of the special case on the axis.
    r = np.sqrt(r2 + 1e-16)
    angle = np.arctan(r)
    a2 = angle * angle
    image = angle * (1.0 + a2 * (k1 + a2 * (k2 + a2 * (k3 + a2 * k4))))
    by_angle = 1.0 + a2 * (3.0 * k1 + a2 * (5.0 * k2 + a2 * (7.0 * k3 + a2 * 9.0 * k4)))
    ratio = image / r
    # d ratio / d r, over r.
    slope = (by_angle / (1.0 + r2) - ratio) / (r * r)
    found = rays * ratio[..., np.newaxis]
    outer = rays[..., :, np.newaxis] * rays[..., np.newaxis, :]
    jacobian = ratio[..., np.newaxis, np.newaxis] * np.eye(2) + outer * slope[..., None, None]
    return found, jacobian
