"""Baselines from training to bundle, and their bounds against their definitions."""

import json
import math

import numpy as np
import pytest
import torch
from scipy.optimize import brentq
from scipy.stats import norm
from torch.nn.functional import linear, prelu

from cvo_edge import Odometer
from cvo_edge.bundle.format import FAMILIARITY, Threshold
from cvo_edge.bundle.reading import read_calibration
from cvo_edge.engine.loading import read_bundle
from cvo_edge.errors import UsageError
from cvo_edge.heads import CqrHead
from cvo_export.bundles.observed import observe
from cvo_export.evaluate import evaluate, find_level, table
from cvo_export.networks.backbone import BackboneConfig
from cvo_export.networks.baselines import BASELINES
from cvo_export.networks.baselines.gaussian import GaussianConfig, GaussianNetwork
from cvo_export.networks.baselines.mc_dropout import McDropoutConfig, McDropoutNetwork
from cvo_export.networks.baselines.mdn import MdnConfig, MdnNetwork, mixture_quantiles
from cvo_export.networks.baselines.pinball import PinballConfig, PinballNetwork
from cvo_export.networks.heads import METHODS
from cvo_export.networks.heads.base import Setting
from cvo_export.networks.methods import TRAINABLE
from cvo_export.networks.standardised import Target
from cvo_export.publish import publish
from cvo_export.training.loop import train
from cvo_export.training.options import method_parameters
from cvo_export.training.run import load_run

from .conftest import ignore_progress, tiny_config
from .test_train import InterruptedTrainingError, same_weights, stopping_after

SETTING = Setting(7, Target.of_arrays([np.array([0.0, 0, 0, 1]), np.zeros(6), np.ones(6)]), 3)
Z = norm.ppf(0.95)


def config_of(name):
    # An early stage and few units keep graphs and checkpoints small.
    backbone = BackboneConfig("test_efficientnet", stages=("8",), grid=(3, 4))
    return tiny_config(head=BASELINES[name].config(hidden=(64, 32)), backbone=backbone)


@pytest.fixture(scope="module", params=list(BASELINES))
def name(request):
    return request.param


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    made = {}

    def of(name):
        if name not in made:
            folder = tmp_path_factory.mktemp("runs") / name
            run = train(folder, config_of(name), ignore_progress)
            bundle = folder.with_name(name + "-bundle")
            publish(run, bundle, name)
            made[name] = (folder, run, bundle)
        return made[name]

    return of


def standardised(run, outputs):
    """Return the graph's lower and upper bounds in the network's units."""
    return [(outputs[key] - run.target.mean) / run.target.std for key in ("lower", "upper")]


@pytest.fixture(scope="module")
def seen(runs):
    """Features of a few frames in torch, and the exported graph's outputs for them."""

    def of(name):
        _, run, bundle = runs(name)
        rows = run.split.roles["test"][:12]
        images = np.stack([run.dataset.read_image(int(row))[:, :, ::-1] for row in rows])
        with Odometer.load(bundle) as odometer, torch.no_grad():
            outputs = observe(odometer, run.dataset, rows).outputs
            return run, run.graph.backbone(torch.from_numpy(images.copy())), outputs

    return of


# -- every baseline -----------------------------------------------------------------------------


def test_every_option_of_a_method_is_one_of_the_command_line():
    options = {parameter.name for parameter in method_parameters(TRAINABLE)}
    configs = [method.config for method in TRAINABLE.values()]
    assert options == {name for config in configs for name in config.__struct_fields__}
    assert set(TRAINABLE) == set(METHODS) | set(BASELINES)
    assert not set(METHODS) & set(BASELINES)


def test_a_bundle_is_one_of_cqr_that_names_its_network(runs, name):
    _, run, bundle = runs(name)
    calibration = read_calibration(bundle)
    assert calibration.method == "cqr"
    assert calibration.provenance.options["network"] == name
    assert calibration.pose.rotation == "tangent_reference"
    with Odometer.load(bundle) as odometer:
        estimate = odometer.step(run.dataset.read_image(int(run.split.roles["test"][0])))
    assert estimate.bounded


def test_evaluation_covers_what_it_states(runs, name):
    _, run, bundle = runs(name)
    report = evaluate(bundle, run.dataset, "test")
    level = find_level(report["levels"], 0.8, "marginal")
    low, high = level["coverage_band"]
    assert low <= np.mean(level["coverage"]) <= high
    json.dumps(report, allow_nan=False)


def test_training_lowers_the_score_on_val(runs, name):
    _, run, _ = runs(name)
    scores = [entry.val_score for entry in run.history]
    assert min(scores) < 0.7 * scores[0]


def test_a_finished_run_is_read_back(runs, name):
    folder, run, _ = runs(name)
    again = load_run(folder)
    assert same_weights(run, again)
    assert again.config == run.config


def test_an_interrupted_run_ends_as_if_it_never_was(runs, tmp_path):
    _, run, _ = runs("mc-dropout")
    config = config_of("mc-dropout")
    with pytest.raises(InterruptedTrainingError):
        train(tmp_path / "run", config, stopping_after(17, "training"))
    resumed = train(tmp_path / "run", config, ignore_progress)
    assert same_weights(run, resumed)
    assert run.history == resumed.history


def test_only_the_point_network_has_the_residual_score(runs, tmp_path):
    _, run, bundle = runs("split")
    assert read_calibration(bundle).calibration.score == "residual"
    names = {spec.name for spec in read_calibration(bundle).model.outputs}
    assert names - FAMILIARITY.keys() == {"pose"}
    with pytest.raises(UsageError, match="expected one of residual"):
        publish(run, tmp_path / "bundle", "other", score="normalised")
    _, run, _ = runs("pinball")
    with pytest.raises(UsageError, match="expected one of normalised, additive"):
        publish(run, tmp_path / "bundle", "other", score="residual")


# -- bounds of the graph against their definitions -----------------------------------------------


def gaussian_of(points):
    """Return 5 % and 95 % quantiles of the Gaussian fitted to points (passes, n, 6)."""
    mean, deviation = points.mean(axis=0), points.std(axis=0)
    return norm.ppf(0.05, mean, deviation), norm.ppf(0.95, mean, deviation)


def assert_bounds(run, outputs, expected):
    for found, wanted in zip(standardised(run, outputs), expected, strict=True):
        np.testing.assert_allclose(found, wanted, atol=2e-4)


def test_dropout_bounds_are_those_of_thirty_passes_one_by_one(seen):
    run, features, outputs = seen("mc-dropout")
    network = run.graph.head.network
    w = {key: value for key, value in network.state_dict().items() if "layers" in key}
    points = []
    for wide, narrow in zip(network.wide_masks, network.narrow_masks, strict=True):
        x = (features - network.standardise.mean) / network.standardise.std
        x = prelu(linear(x, w["layers.0.weight"], w["layers.0.bias"]), w["layers.1.weight"]) * wide
        x = linear(x, w["layers.3.weight"], w["layers.3.bias"])
        x = prelu(x, w["layers.4.weight"]) * narrow
        points.append(linear(x, w["layers.6.weight"], w["layers.6.bias"]).detach().numpy())
    assert len(points) == 30
    assert_bounds(run, outputs, gaussian_of(np.array(points)))
    np.testing.assert_allclose(
        outputs["pose"][:, :3],
        (np.mean(points, axis=0) * run.target.std + run.target.mean)[:, :3],
        atol=1e-4,
    )


def test_dropout_masks_keep_their_share_and_come_from_the_seed():
    network = McDropoutNetwork(SETTING, McDropoutConfig(dropout=0.3))
    masks = torch.cat([network.wide_masks, network.narrow_masks], dim=1)
    assert set(masks.unique().tolist()) == {0.0, np.float32(1 / 0.7)}
    share = (masks == 0).float().mean().item()
    assert abs(share - 0.3) < 5 * math.sqrt(0.3 * 0.7 / masks.numel())
    again = McDropoutNetwork(SETTING, McDropoutConfig(dropout=0.3))
    assert torch.equal(network.wide_masks, again.wide_masks)
    other = McDropoutNetwork(SETTING._replace(seed=4), McDropoutConfig(dropout=0.3))
    assert not torch.equal(network.wide_masks, other.wide_masks)


def test_ensemble_bounds_are_those_of_the_mixture_of_five_networks_one_by_one(seen):
    run, features, outputs = seen("ensemble")
    network = run.graph.head.network
    x = network.standardise.eval()(features)
    found = np.array([member(x).detach().numpy() for member in network.members]).astype(float)
    mean, variance = found[..., :6], np.exp(found[..., 6:])
    assert len(mean) == 5
    # Second moment of the mixture minus the square of its mean.
    deviation = np.sqrt((variance + mean**2).mean(axis=0) - mean.mean(axis=0) ** 2)
    point = mean.mean(axis=0)
    assert_bounds(run, outputs, (point - Z * deviation, point + Z * deviation))


def test_members_of_the_ensemble_differ_in_initialisation_and_noise(runs):
    _, run, _ = runs("ensemble")
    network = run.graph.head.network
    first, second = (member[0].weight for member in list(network.members)[:2])
    assert not torch.equal(first, second)
    for member in network.members:
        member.load_state_dict(network.members[0].state_dict())
    features = torch.zeros((4, run.graph.backbone.size))
    alike, noisy = network.eval().moments(features)[0], network.train().moments(features)[0]
    network.eval()
    assert torch.equal(alike[:, 0], alike[:, 1])
    assert not torch.equal(noisy[:, 0], noisy[:, 1])


def test_gaussian_bounds_hold_ninety_percent_of_its_gaussian(seen):
    run, features, outputs = seen("gaussian")
    mean, log_variance = (v.detach().numpy() for v in run.graph.head.network.moments(features))
    deviation = np.exp(0.5 * log_variance)
    assert_bounds(run, outputs, (mean - Z * deviation, mean + Z * deviation))


def test_gaussian_loss_is_the_negative_log_likelihood():
    network = GaussianNetwork(SETTING, GaussianConfig()).eval()
    features, y = torch.randn(64, 7), torch.randn(64, 6)
    mean, log_variance = (v.detach().numpy() for v in network.moments(features))
    likelihood = norm.logpdf(y.numpy(), mean, np.exp(0.5 * log_variance))
    expected = -likelihood.mean() - 0.5 * math.log(2 * math.pi)
    assert network.loss(features, y, False).item() == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize(
    "network", [GaussianNetwork(SETTING, GaussianConfig()), MdnNetwork(SETTING, MdnConfig())]
)
def test_variances_stay_finite_wherever_training_goes(network):
    with torch.no_grad():
        network.layers[-1].weight.mul_(1e4)
    features, y = torch.randn(64, 7), torch.randn(64, 6)
    point, lower, upper = network.eval()(features)
    assert torch.isfinite(torch.cat([point, lower, upper])).all()
    assert (lower < upper).all()
    assert torch.isfinite(network.loss(features, y, False))


def mixture_cdf(y, weight, mean, deviation):
    return (weight * norm.cdf(y[..., np.newaxis], mean, deviation)).sum(axis=-1)


def test_mixture_bounds_are_its_quantiles(seen):
    run, features, outputs = seen("mdn")
    mixture = run.graph.head.network.mixture(features)
    log_weight, mean, log_deviation = (v.detach().double().numpy() for v in mixture)
    weight, deviation = np.exp(log_weight), np.exp(log_deviation)
    for bound, level in zip(standardised(run, outputs), (0.05, 0.95), strict=True):
        np.testing.assert_allclose(mixture_cdf(bound, weight, mean, deviation), level, atol=1e-3)
    np.testing.assert_allclose(
        outputs["pose"][:, :3],
        ((weight * mean).sum(axis=-1) * run.target.std + run.target.mean)[:, :3],
        atol=1e-4,
    )


def test_quantiles_of_mixtures_far_apart_and_narrow_are_found():
    generator = np.random.default_rng(0)
    weight = generator.dirichlet(np.ones(4), (40, 6))
    mean = 3.0 * generator.standard_normal((40, 6, 4))
    deviation = np.exp(generator.uniform(-5.0, 2.0, (40, 6, 4)))
    tensors = (torch.from_numpy(values).float() for values in (weight, mean, deviation))
    found = mixture_quantiles(*tensors, (0.05, 0.95)).double().numpy()
    for side, level in enumerate((0.05, 0.95)):
        for row, dof in np.ndindex(40, 6):
            at = (weight[row, dof], mean[row, dof], deviation[row, dof])
            exact = brentq(lambda y, a=at, p=level: mixture_cdf(np.array(y), *a) - p, -60, 60)
            # Where the density is low, a small error in the level moves the quantile further.
            assert abs(mixture_cdf(found[row, side, dof], *at) - level) < 1e-4
            assert abs(found[row, side, dof] - exact) < 1e-3


def test_mixture_loss_is_the_negative_log_likelihood():
    network = MdnNetwork(SETTING, MdnConfig()).eval()
    features, y = torch.randn(64, 7), torch.randn(64, 6)
    log_weight, mean, log_deviation = (v.detach().numpy() for v in network.mixture(features))
    density = norm.pdf(y.numpy()[..., np.newaxis], mean, np.exp(log_deviation))
    expected = -np.log((np.exp(log_weight) * density).sum(axis=-1)).mean()
    constant = 0.5 * math.log(2 * math.pi)
    found = network.loss(features, y, False).item() + constant
    assert found == pytest.approx(expected, rel=1e-4)


def test_quantiles_never_cross_and_are_those_of_the_network(seen):
    run, features, outputs = seen("pinball")
    network = run.graph.head.network
    found = np.sort(network.quantiles(features).detach().numpy(), axis=1)
    assert_bounds(run, outputs, (found[:, 0], found[:, 2]))
    untrained = PinballNetwork(SETTING, PinballConfig()).eval()
    features = 20.0 * torch.randn(200, 7)
    low, middle, high = untrained.quantiles(features).unbind(dim=1)
    assert ((low > middle) | (middle > high)).any()
    point, lower, upper = untrained(features)
    assert ((lower <= point) & (point <= upper)).all()


def test_the_pinball_loss_is_least_at_the_quantiles():
    network = PinballNetwork(SETTING, PinballConfig()).eval()
    y = torch.randn(4000, 6)
    exact = torch.quantile(y, torch.tensor([0.05, 0.5, 0.95]), dim=0)

    def loss(quantiles):
        network.quantiles = lambda _: quantiles.expand(4000, 3, 6)
        return network.loss(torch.zeros(4000, 7), y, False).item()

    for row in range(3):
        for shift in (-0.1, 0.1):
            moved = exact.clone()
            moved[row] += shift
            assert loss(moved) > loss(exact)


# -- their figures in the report -----------------------------------------------------------------


@pytest.mark.parametrize("name", ["gaussian", "split"])
def test_own_figures_are_those_of_cqr_at_the_threshold_zero(runs, name):
    _, run, bundle = runs(name)
    report = evaluate(bundle, run.dataset, "test")
    if name == "split":
        assert report["own"] is None
        assert not any("own bounds" in line for line in table(report))
        return
    content = read_bundle(bundle)
    head = CqrHead(content.head.parameters, "additive")
    zero = Threshold(confidence=0.9, scope="marginal", q_hat=(0.0,) * 6, q_hat_upper=None)
    with Odometer(content) as odometer:
        seen = observe(odometer, run.dataset, run.split.roles["test"])
    regions = seen.sets(head, zero)
    covered = np.array([r.covers(y) for r, y in zip(regions, seen.truth, strict=True)])
    distance = np.array([r.distance(y) for r, y in zip(regions, seen.truth, strict=True)])
    width = np.array([region.width() for region in regions])
    own = report["own"]
    np.testing.assert_allclose(own["coverage"], covered.mean(axis=0))
    assert own["joint_coverage"] == pytest.approx(covered.all(axis=1).mean())
    np.testing.assert_allclose(own["mean_width"], width.mean(axis=0))
    score = (width + 20.0 * distance).mean(axis=0)
    np.testing.assert_allclose(own["interval_score"], score)
    assert own["normalised_interval_score"] == pytest.approx((score / run.target.std).mean())
    assert sum("own bounds" in line for line in table(report)) == 1


def test_joint_volume_is_the_product_of_the_widths(runs):
    _, run, bundle = runs("gaussian")
    levels = evaluate(bundle, run.dataset, "test")["levels"]
    assert all(("joint_volume" in level) == (level["scope"] == "joint") for level in levels)
    with Odometer.load(bundle, scope="joint", confidence=0.8) as odometer:
        frames = [run.dataset.read_image(i) for i in run.split.roles["test"].tolist()]
        volumes = [
            np.prod((estimate.upper - estimate.lower) / run.target.std)
            for estimate in odometer.stream(frames)
        ]
    found = find_level(levels, 0.8, "joint")["joint_volume"]
    assert found["mean"] == pytest.approx(np.mean(volumes))
    assert found["median"] == pytest.approx(np.median(volumes))
    assert found["geometric_mean"] == pytest.approx(np.exp(np.mean(np.log(volumes))))
    # Unbounded sets are limited to the workspace.
    limits = read_calibration(bundle).pose.limits
    space = np.prod((np.array(limits.highest) - limits.lowest) / run.target.std)
    found = find_level(levels, 0.99, "joint")["joint_volume"]
    assert found["geometric_mean"] == pytest.approx(space)
