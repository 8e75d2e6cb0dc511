"""Forest weights and quantiles against independent implementations; the graph against numpy."""

import numpy as np
import pytest
from onnx import TensorProto, helper
from quantile_forest import RandomForestQuantileRegressor
from sklearn.ensemble import RandomForestRegressor

from cvo_edge.engine.session import Session
from cvo_export.networks.forest import (
    MAX_LEAF_ENTRIES,
    ML_DOMAIN,
    ML_OPSET,
    _not_above,
    forest_of,
    grow,
    quantile_nodes,
)

TREES, LEAF, FEATURES = 40, 10, 8


def data(rows, outputs=3, seed=0):
    generator = np.random.default_rng(seed)
    x = generator.standard_normal((rows, FEATURES)).astype(np.float32)
    noise = generator.standard_normal((rows, outputs)) * (0.2 + np.abs(x[:, :1]))
    return x, x[:, :outputs] + noise


@pytest.fixture(scope="module")
def forest():
    x, y = data(600)
    return grow(x, y, np.ones(3), trees=TREES, leaf_size=LEAF, share=0.5, seed=3)


def graph_of(forest, taus):
    names = [f"quantile{number}" for number in range(len(taus))]
    nodes, constants = quantile_nodes(forest, taus, "x", names, "forest/")
    columns = forest.labels.shape[1]
    graph = helper.make_graph(
        nodes,
        "forest",
        [helper.make_tensor_value_info("x", TensorProto.FLOAT, [1, FEATURES])],
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, columns]) for name in names],
        constants,
    )
    opsets = [helper.make_opsetid("", 18), helper.make_opsetid(ML_DOMAIN, ML_OPSET)]
    model = helper.make_model(graph, opset_imports=opsets, ir_version=10)
    return Session(model.SerializeToString(), threads=1)


def test_no_quantile_of_the_graph_differs_from_the_float64_reference(forest):
    # 1000 inputs x 3 outputs x 2 levels give 6000 quantiles. Half of the inputs are training rows,
    # which lie near many thresholds but never exactly on one.
    x = np.concatenate([data(500, seed=9)[0], data(600)[0][:500]])
    taus = (0.05, 0.95)
    session = graph_of(forest, taus)
    found = [session.run({"x": row[np.newaxis]}) for row in x]
    for number, tau in enumerate(taus):
        graph = np.concatenate([outputs[f"quantile{number}"] for outputs in found])
        assert (graph != forest.quantiles(x, tau)).sum() == 0


def test_an_input_on_a_threshold_goes_the_same_way_in_graph_and_reference(forest):
    inner = np.flatnonzero(forest.feature >= 0)[:300]
    x = np.zeros((inner.size, FEATURES), np.float32)
    x[np.arange(inner.size), forest.feature[inner]] = forest.threshold[inner]
    session = graph_of(forest, (0.5,))
    graph = np.concatenate([session.run({"x": row[np.newaxis]})["quantile0"] for row in x])
    np.testing.assert_array_equal(graph, forest.quantiles(x, 0.5))


def test_weights_are_those_of_scikit_learns_leaves(forest):
    x, y = data(600)
    new, _ = data(50, seed=5)
    grown = RandomForestRegressor(
        TREES, min_samples_leaf=LEAF, max_features=0.5, random_state=3
    ).fit(x, y)
    own, found = grown.apply(x), grown.apply(new)
    expected = np.zeros((50, 600))
    for tree in range(TREES):
        for row in range(50):
            members = np.flatnonzero(own[:, tree] == found[row, tree])
            expected[row, members] += 1.0 / (TREES * members.size)
    weights = forest.weights(new)
    np.testing.assert_allclose(weights, expected, atol=1e-15)
    np.testing.assert_allclose(weights.sum(axis=1), 1.0, atol=1e-12)


def test_a_quantile_is_the_least_label_whose_distribution_reaches_the_level(forest):
    new, _ = data(40, seed=6)
    weights = forest.weights(new)
    for tau in (0.05, 0.5, 0.95):
        quantiles = forest.quantiles(new, tau)
        for column in range(3):
            labels = forest.labels[:, column]
            for w, q in zip(weights, quantiles[:, column], strict=True):
                assert w[labels <= q].sum() >= tau - 2e-6
                assert w[labels < q].sum() < tau - 1e-6 + 1e-9


@pytest.mark.parametrize("tau", [0.05, 0.5, 0.95])
def test_quantiles_agree_with_quantile_forest_up_to_one_weight(tau):
    # quantile-forest uses only the rows in a tree's bag, so these trees have no bootstrap. If it
    # keeps all samples of a leaf and weights leaves inversely to their size, its weights are
    # Meinshausen's. It interpolates between two labels at the rank (N - 1) tau + 1; ours is the
    # first label that reaches tau. On the scale of F, the two differ by less than two weights.
    x, y = data(400, outputs=1)
    new, _ = data(200, seed=7)
    settings = {"min_samples_leaf": LEAF, "max_features": 0.5, "random_state": 0}
    oracle = RandomForestQuantileRegressor(
        TREES, bootstrap=False, max_samples_leaf=None, **settings
    ).fit(x, y[:, 0])
    plain = RandomForestRegressor(TREES, bootstrap=False, **settings).fit(x, y[:, 0])
    forest = forest_of(plain, x, y)
    predicted = oracle.predict(
        new, quantiles=[tau], weighted_quantile=True, weighted_leaves=True
    ).reshape(-1)
    ours = forest.quantiles(new, tau)[:, 0]
    labels = forest.labels[:, 0]
    for w, theirs, own in zip(forest.weights(new), predicted, ours, strict=True):
        low, high = min(theirs, own), max(theirs, own)
        between = w[(labels > low + 1e-6) & (labels < high - 1e-6)].sum()
        assert between <= 2 * w.max()
    assert np.mean(np.abs(predicted - ours)) < 0.05 * y.std()


def test_thresholds_are_the_largest_float32_not_above():
    values = np.random.default_rng(0).standard_normal(10_000)
    found = _not_above(values)
    assert (found.astype(np.float64) <= values).all()
    assert (np.nextafter(found, np.float32(np.inf)).astype(np.float64) > values).all()
    exact = values.astype(np.float32).astype(np.float64)
    np.testing.assert_array_equal(_not_above(exact), exact.astype(np.float32))


def test_too_many_rows_are_thinned_to_the_cap():
    x, y = data(5000, outputs=1)
    forest = grow(x, y, np.ones(1), trees=200, leaf_size=50, share=0.5, seed=0)
    assert forest.leaf.size <= MAX_LEAF_ENTRIES
    np.testing.assert_allclose(forest.weights(x[:20]).sum(axis=1), 1.0, atol=1e-12)
