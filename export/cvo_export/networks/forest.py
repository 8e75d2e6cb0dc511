"""Quantile regression forests (Meinshausen 2006): weights and quantiles, in numpy and in ONNX.

A forest of T trees gives every training row i a weight at x,

    w_i(x) = 1/T sum_t 1{row i in the leaf of x in tree t} / rows in that leaf,

over *all* rows, whether or not they are in a tree's bag; F(y | x) = sum_i w_i(x) 1{y_i <= y} and
the quantile at tau is the smallest y_i with F(y_i | x) >= tau. scikit-learn grows the trees; this
module does the rest, once in numpy and once as a graph of standard operators.

The library quantile-forest aggregates differently: by default it keeps one random row per leaf,
pools leaves without weights, interpolates between labels, and uses only the rows in a tree's bag.
With all rows kept, weighted leaves and no bootstrap it agrees up to the interpolation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray
from onnx import NodeProto, TensorProto, helper, numpy_helper
from sklearn.ensemble import RandomForestRegressor

Array = NDArray[np.float64]

ML_DOMAIN, ML_OPSET = "ai.onnx.ml", 3

# Tolerance: weights are multiples of 1/(T rows), and a sum equal to tau must not fail by rounding.
TAU_TOLERANCE = 1e-6
# Total entries of all leaf lists: 400k cost 0.6 ms per frame and 80 MB at load.
MAX_LEAF_ENTRIES = 400_000


@dataclass(frozen=True, eq=False)
class Forest:
    """A grown forest as arrays.

    Attributes
    ----------
    feature, threshold, left, right
        Per node of all trees: a row goes left if x[feature] <= threshold (float32), otherwise
        right; feature is -1 at leaves. Children are node indices.
    root
        First node of each tree.
    leaf
        Shape (trees, rows): the leaf node of each training row.
    labels
        Shape (rows, outputs), float32.
    """

    feature: NDArray[np.int64]
    threshold: NDArray[np.float32]
    left: NDArray[np.int64]
    right: NDArray[np.int64]
    root: NDArray[np.int64]
    leaf: NDArray[np.int64]
    labels: NDArray[np.float32]

    @property
    def rows(self) -> int:
        """Number of training rows."""
        return len(self.labels)

    def leaves(self, x: NDArray[np.float32]) -> NDArray[np.int64]:
        """Inputs (n, features) -> leaf node in each tree, (trees, n)."""
        found = []
        for root in self.root:
            node = np.full(len(x), root)
            while (inner := self.feature[node] >= 0).any():
                at = node[inner]
                smaller = x[inner, self.feature[at]] <= self.threshold[at]
                node[inner] = np.where(smaller, self.left[at], self.right[at])
            found.append(node)
        return np.stack(found)

    def weights(self, x: NDArray[np.float32]) -> Array:
        """Inputs (n, features) -> w (n, rows), float64; each row sums to 1."""
        total = np.zeros((len(x), self.rows))
        for found, own in zip(self.leaves(x), self.leaf, strict=True):
            together = found[:, np.newaxis] == own[np.newaxis, :]
            total += together / (len(self.root) * together.sum(axis=1, keepdims=True))
        return total

    def quantiles(self, x: NDArray[np.float32], tau: float) -> NDArray[np.float32]:
        """Inputs (n, features) -> the quantile of every output at tau, (n, outputs)."""
        weights = self.weights(x)
        columns = []
        for labels in self.labels.T:
            order = np.argsort(labels, kind="stable")
            reached = np.cumsum(weights[:, order], axis=1) >= tau - TAU_TOLERANCE
            columns.append(labels[order][reached.argmax(axis=1)])
        return np.stack(columns, axis=1)


def grow(
    x: NDArray[np.float32],
    y: Array,
    scale: Array,
    *,
    trees: int,
    leaf_size: int,
    share: float,
    seed: int,
) -> Forest:
    """Grow a forest from inputs (rows, features) and labels (rows, outputs).

    ``scale`` (outputs,) makes the labels comparable in the split criterion; each split tries
    ``share`` of the features. Above ``MAX_LEAF_ENTRIES``, a random subset of the rows is used.
    """
    most = max(1, MAX_LEAF_ENTRIES // trees)
    if len(x) > most:
        kept = np.sort(np.random.default_rng(seed).permutation(len(x))[:most])
        x, y = x[kept], y[kept]
    grown = RandomForestRegressor(
        trees, min_samples_leaf=leaf_size, max_features=share, random_state=seed, n_jobs=-1
    ).fit(x, (y / scale).squeeze())
    return forest_of(grown, x, y)


def forest_of(grown: RandomForestRegressor, x: NDArray[np.float32], y: Array) -> Forest:
    """Copy the trees of a fitted forest; assign rows (rows, features) and labels to leaves."""
    parts: dict[str, list[NDArray[np.generic]]] = {name: [] for name in ("f", "t", "l", "r")}
    roots, leaves, start = [], [], 0
    for estimator in grown.estimators_:
        tree = estimator.tree_
        inner = tree.children_left >= 0
        parts["f"].append(np.where(inner, tree.feature, -1))
        parts["t"].append(_not_above(np.where(inner, tree.threshold, 0.0)))
        parts["l"].append(np.where(inner, tree.children_left + start, 0))
        parts["r"].append(np.where(inner, tree.children_right + start, 0))
        leaves.append(tree.apply(x) + start)
        roots.append(start)
        start += tree.node_count
    f, t, left, right = (np.concatenate(part) for part in parts.values())
    return Forest(
        feature=f.astype(np.int64),
        threshold=t.astype(np.float32),
        left=left.astype(np.int64),
        right=right.astype(np.int64),
        root=np.array(roots),
        leaf=np.stack(leaves).astype(np.int64),
        labels=y.astype(np.float32),
    )


def _not_above(threshold: Array) -> NDArray[np.float32]:
    """Largest float32 not above each number: x <= threshold is then unchanged for float32 x."""
    rounded = threshold.astype(np.float32)
    above = rounded.astype(np.float64) > threshold
    return np.where(above, np.nextafter(rounded, np.float32(-np.inf)), rounded)


def forest_fields() -> tuple[str, ...]:
    """Return the names of the arrays that define a forest."""
    return tuple(field.name for field in fields(Forest))


# -- inside ONNX --------------------------------------------------------------------------------


def quantile_nodes(
    forest: Forest, taus: Sequence[float], x: str, outputs: Sequence[str], prefix: str
) -> tuple[list[NodeProto], list[TensorProto]]:
    """Return nodes and constants that compute the quantiles at ``taus`` of the tensor ``x``.

    ``x`` is float32 [1, features]; each of ``outputs`` becomes float32 [1, columns of the labels].
    All other names begin with ``prefix``. One tree ensemble has every row as a target, so that it
    outputs w(x); sums run in float64, as in ``Forest.quantiles``.
    """
    order = np.argsort(forest.labels, axis=0, kind="stable").T
    columns = order.shape[0]
    starts = np.arange(columns)[:, np.newaxis] * forest.rows
    constants = [
        numpy_helper.from_array(values, prefix + name)
        for name, values in {
            "order": order.reshape(-1).astype(np.int64),
            "shape": np.array([columns, forest.rows]),
            "axis": np.array(1),
            "starts": starts[:, 0].astype(np.int64),
            "sorted": np.take_along_axis(forest.labels.T, order, axis=1).reshape(-1),
            "row": np.array([1, columns]),
        }.items()
    ]
    nodes = [
        helper.make_node(
            "TreeEnsembleRegressor",
            [x],
            [prefix + "weights"],
            name=prefix + "forest",
            domain=ML_DOMAIN,
            n_targets=forest.rows,
            aggregate_function="SUM",
            post_transform="NONE",
            **_tree_attributes(forest),
        )
    ]

    def add(kind: str, inputs: Sequence[str], output: str, **attributes: Any) -> None:  # noqa: ANN401
        names = [prefix + name for name in inputs]
        nodes.append(helper.make_node(kind, names, [output], name=output + "_node", **attributes))

    flat = [prefix + "weights", prefix + "flat_shape"]
    constants.append(numpy_helper.from_array(np.array([-1]), prefix + "flat_shape"))
    nodes.append(helper.make_node("Reshape", flat, [prefix + "flat"], name=prefix + "flatten"))
    add("Gather", ["flat", "order"], prefix + "ordered")
    add("Reshape", ["ordered", "shape"], prefix + "by_column")
    add("Cast", ["by_column"], prefix + "double", to=TensorProto.DOUBLE)
    add("CumSum", ["double", "axis"], prefix + "cumulative")
    for number, (tau, output) in enumerate(zip(taus, outputs, strict=True)):
        level = numpy_helper.from_array(np.array(tau - TAU_TOLERANCE), f"{prefix}tau{number}")
        constants.append(level)
        add("GreaterOrEqual", ["cumulative", f"tau{number}"], f"{prefix}reached{number}")
        add("Cast", [f"reached{number}"], f"{prefix}steps{number}", to=TensorProto.INT32)
        # ArgMax returns the first of equal elements.
        add("ArgMax", [f"steps{number}"], f"{prefix}first{number}", axis=1, keepdims=0)
        add("Add", [f"first{number}", "starts"], f"{prefix}index{number}")
        add("Gather", ["sorted", f"index{number}"], f"{prefix}quantile{number}")
        add("Reshape", [f"quantile{number}", "row"], output)
    return nodes, constants


def _tree_attributes(forest: Forest) -> dict[str, Any]:
    """Return the TreeEnsembleRegressor attributes; node ids start at 0 in each tree."""
    nodes = np.arange(forest.feature.size)
    tree = np.searchsorted(forest.root, nodes, side="right") - 1
    first = forest.root[tree]
    inner = forest.feature >= 0
    # One entry per tree and row: the row weighs 1 / (trees * rows in the leaf) in its leaf.
    leaf = forest.leaf.reshape(-1)
    row = np.tile(np.arange(forest.rows), len(forest.root))
    count = np.bincount(leaf, minlength=nodes.size)
    weight = 1.0 / (len(forest.root) * count[leaf])
    by_leaf = np.argsort(leaf, kind="stable")
    return {
        "nodes_treeids": tree.tolist(),
        "nodes_nodeids": (nodes - first).tolist(),
        "nodes_featureids": np.where(inner, forest.feature, 0).tolist(),
        "nodes_values": forest.threshold.astype(np.float64).tolist(),
        "nodes_modes": np.where(inner, "BRANCH_LEQ", "LEAF").tolist(),
        "nodes_truenodeids": np.where(inner, forest.left - first, 0).tolist(),
        "nodes_falsenodeids": np.where(inner, forest.right - first, 0).tolist(),
        "target_treeids": tree[leaf[by_leaf]].tolist(),
        "target_nodeids": (leaf - first[leaf])[by_leaf].tolist(),
        "target_ids": row[by_leaf].tolist(),
        "target_weights": weight[by_leaf].tolist(),
    }
