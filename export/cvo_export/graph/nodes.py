"""ONNX nodes under construction, with the conversions of rotations that adapters need."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import helper, numpy_helper

# Rows of 4 q qT of a rotation matrix (row by row, 9 numbers), as a linear map and a constant.
_TERMS = {
    (0, 0): ((0, 1), (4, -1), (8, -1)),
    (1, 1): ((0, -1), (4, 1), (8, -1)),
    (2, 2): ((0, -1), (4, -1), (8, 1)),
    (3, 3): ((0, 1), (4, 1), (8, 1)),
    (0, 1): ((1, 1), (3, 1)),
    (0, 2): ((2, 1), (6, 1)),
    (1, 2): ((5, 1), (7, 1)),
    (0, 3): ((7, 1), (5, -1)),
    (1, 3): ((2, 1), (6, -1)),
    (2, 3): ((3, 1), (1, -1)),
}
_TINY = 1e-12


class Nodes:
    """Nodes and constants; every method returns the name of its result, shape (1, n)."""

    def __init__(self, prefix: str) -> None:
        self.prefix = prefix
        self._nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []
        self._count = 0

    def __call__(self, kind: str, *inputs: str, **attributes: int | list[int]) -> str:
        """Append one node."""
        self._count += 1
        result = f"{self.prefix}{self._count}"
        self._nodes.append(
            helper.make_node(kind, inputs, [result], **attributes)  # type: ignore[arg-type]
        )
        return result

    def constant(self, values: NDArray[Any]) -> str:
        """Append a constant."""
        name = f"{self.prefix}constant{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(np.asarray(values), name))
        return name

    def name(self, result: str, name: str) -> None:
        """Give a result that no other node reads yet its final name."""
        for node in self._nodes:
            node.output[:] = [name if output == result else output for output in node.output]

    def taken(self) -> list[onnx.NodeProto]:
        """Return the nodes so far and start anew."""
        taken, self._nodes = self._nodes, []
        return taken

    def columns(self, values: str, indices: Iterable[int]) -> str:
        """Return chosen columns of (1, n)."""
        return self("Gather", values, self.constant(np.array(list(indices))), axis=1)

    def quaternion(self, values: str, form: str) -> str:
        """Return the unit quaternion qx qy qz qw of a rotation in one of the forms."""
        if form == "quaternion_wxyz":
            return self.columns(values, (1, 2, 3, 0))
        if form in ("rotvec", "logq"):
            return self._exponential(values, 0.5 if form == "rotvec" else 1.0)
        if form in ("six", "six_rows"):
            return self._from_matrix(self._orthonormal(values, form == "six"))
        return self._from_matrix(values) if form == "matrix" else values

    def rotated(self, rotation: str, position: str) -> str:
        """Return a position turned by a unit quaternion: v + 2 w (u x v) + 2 u x (u x v)."""
        axis = self._unit(rotation)
        u, w = self.columns(axis, range(3)), self.columns(axis, (3,))
        turned = self._cross(u, position)
        twice = self("Add", turned, turned)
        return self("Add", self("Add", position, self("Mul", w, twice)), self._cross(u, twice))

    def half_turn_about_x(self, rotation: str) -> str:
        """Return q (1 0 0 0): the camera's y and z axes change their direction."""
        turn = np.zeros((4, 4), np.float32)
        turn[[3, 2, 1, 0], [0, 1, 2, 3]] = 1, 1, -1, -1
        return self("MatMul", rotation, self.constant(turn))

    def _exponential(self, values: str, half: float) -> str:
        """Return (sin|h| h / |h|, cos|h|) of h, ``half`` times the values."""
        h = self("Mul", values, self.constant(np.array(half, np.float32)))
        angle = self._norm(h)
        axis = self("Mul", h, self("Div", self("Sin", angle), angle))
        return self("Concat", axis, self("Cos", angle), axis=1)

    def _from_matrix(self, values: str) -> str:
        """Return the row of 4 q qT with the largest diagonal, normalised (Shepperd 1978)."""
        linear, ones = np.zeros((9, 16), np.float32), np.zeros((1, 16), np.float32)
        for (row, column), terms in _TERMS.items():
            for entry, sign in terms:
                linear[entry, [4 * row + column, 4 * column + row]] = sign
        ones[0, ::5] = 1
        product = self("MatMul", values, self.constant(linear))
        product = self("Add", product, self.constant(ones))
        best = self("ArgMax", self.columns(product, (0, 5, 10, 15)), axis=1, keepdims=0)
        rows = self("Reshape", product, self.constant(np.array([4, 4])))
        return self._unit(self("Gather", rows, best, axis=0))

    def _orthonormal(self, values: str, columns: bool) -> str:
        """Return a matrix (1, 9) from its first two columns or rows (Zhou et al. 2019)."""
        x = self._unit(self.columns(values, range(3)))
        z = self._unit(self._cross(x, self.columns(values, range(3, 6))))
        stacked = self("Concat", x, self._cross(z, x), z, axis=1)
        return self.columns(stacked, (0, 3, 6, 1, 4, 7, 2, 5, 8)) if columns else stacked

    def _cross(self, a: str, b: str) -> str:
        yzx, zxy = (1, 2, 0), (2, 0, 1)
        first = self("Mul", self.columns(a, yzx), self.columns(b, zxy))
        return self("Sub", first, self("Mul", self.columns(a, zxy), self.columns(b, yzx)))

    def _norm(self, values: str) -> str:
        """Return the length (1, 1), not zero."""
        # Without axes the node has one form in every opset.
        length = self("ReduceL2", values, keepdims=1)
        return self("Max", length, self.constant(np.full((1, 1), _TINY, np.float32)))

    def _unit(self, values: str) -> str:
        return self("Div", values, self._norm(values))
