"""Directional quantiles: rays agree with half-spaces, and regions have the stated coverage."""

import copy
from functools import cache

import numpy as np
import pytest
import torch

from cvo_edge.conformal import conformal_quantile
from cvo_export.networks.directional import (
    SHELLS,
    Choice,
    RegionConfig,
    RegionNetwork,
    best_choice,
    fibonacci_sphere,
    mean_volume,
    scaled_distances,
    thrifty_choice,
)
from cvo_export.networks.losses import pinball_loss


@pytest.fixture
def network():
    torch.manual_seed(0)
    return RegionNetwork(RegionConfig(response=6, condition=4)).eval()


@pytest.fixture
def condition():
    return torch.randn(3, 4, generator=torch.Generator().manual_seed(1))


def latents(network, c, kappa):
    """Return the codebook's latents before decoding, (n, J, 3)."""
    network._decoded = lambda z, c: z
    with torch.no_grad():
        return network.codebook(c, torch.tensor(kappa))


def test_directions_are_unit_vectors_spread_over_the_sphere():
    points = fibonacci_sphere(128)
    torch.testing.assert_close(points.norm(dim=1), torch.ones(128))
    assert points.mean(dim=0).abs().max() < 0.02
    # Every point of the sphere has a direction within 15 degrees.
    others = fibonacci_sphere(1000)
    assert (others @ points.T).amax(dim=1).min() > np.cos(np.deg2rad(15.0))


def test_the_codebook_fills_the_half_spaces_to_the_edge_and_not_beyond(network, condition):
    z = latents(network, condition, 1.0)
    with torch.no_grad():
        quantile = network.quantile(condition, network.centre(condition))
        above = z @ network.directions.T - quantile[:, None]
    assert z.shape == (3, 1 + 128 * len(SHELLS), 3)
    assert above.min() > -1e-4
    # The last point of a ray lies on the border of the first half-space that it meets.
    torch.testing.assert_close(above[:, -128:].amin(dim=2), torch.zeros(3, 128), atol=1e-4, rtol=0)
    assert above[:, 0].min() > 0.0


def test_kappa_inflates_about_the_centre(network, condition):
    once, twice = latents(network, condition, 1.0), latents(network, condition, 2.0)
    torch.testing.assert_close(once[:, :1], twice[:, :1])
    torch.testing.assert_close(2.0 * (once - once[:, :1]), twice - twice[:, :1])


def test_the_grid_has_points_inside_only_and_they_lie_in_all_half_spaces(network, condition):
    network._decoded = lambda z, c: z
    with torch.no_grad():
        z, inside = network.grid_codebook(condition, side=9)
        quantile = network.quantile(condition, network.centre(condition))
    assert z.shape == (3, 9**3, 3)
    assert (z @ network.directions.T - quantile[:, None]).min() > -1e-4
    assert inside.any(dim=1).all()
    assert not inside.all()


def test_the_first_layer_split_in_two_is_the_decoder(network, condition):
    with torch.no_grad():
        codebook = network.codebook(condition, torch.tensor(0.8))
        z = latents(network, condition, 0.8)
        together = torch.cat([z, condition[:, None].expand(-1, z.shape[1], -1)], dim=2)
        torch.testing.assert_close(codebook, network.decoder(together))


def test_the_scale_is_lower_triangular_with_a_positive_diagonal(network, condition):
    with torch.no_grad():
        scale = network.scale(condition)
    assert (scale.diagonal(dim1=1, dim2=2) > 0).all()
    torch.testing.assert_close(scale, scale.tril())
    assert scale.tril(-1).abs().max() > 0
    constant = RegionNetwork(RegionConfig(response=6, condition=4, local_scale=False))
    torch.testing.assert_close(constant.scale(condition), torch.eye(6).expand(3, 6, 6))


@pytest.mark.parametrize("tau", [0.05, 0.5, 0.9])
def test_the_constant_of_least_pinball_loss_is_the_quantile(tau):
    y = torch.randn(20_001, generator=torch.Generator().manual_seed(0))
    candidates = torch.linspace(-3, 3, 601)
    losses = [pinball_loss(value.expand_as(y), y, tau) for value in candidates]
    best = candidates[int(torch.stack(losses).argmin())]
    assert best == pytest.approx(float(y.quantile(tau)), abs=0.02)


def fitted(make):
    """Return a network briefly fitted to y (n, 2) given x (n, 1)."""
    return copy.deepcopy(_fitted_once(make))


@cache
def _fitted_once(make):
    torch.manual_seed(0)
    generator = np.random.default_rng(0)
    network = RegionNetwork(RegionConfig(response=2, condition=1))
    optimiser = torch.optim.Adam(network.parameters(), lr=3e-3)
    for _ in range(400):
        x, y = make(256, generator)
        optimiser.zero_grad()
        network.loss(torch.tensor(x).float(), torch.tensor(y).float()).backward()
        optimiser.step()
    return network.eval()


def two_pieces(count, generator):
    x = generator.uniform(0.0, 1.0, (count, 1))
    side = generator.choice([-1.0, 1.0], (count, 1))
    return x, side * (1.0 + 2.0 * x) + 0.2 * generator.standard_normal((count, 2))


def test_a_region_of_two_pieces_covers_them_and_little_of_the_gap():
    network = fitted(two_pieces)
    generator = np.random.default_rng(1)
    with torch.no_grad():
        x, y = two_pieces(500, generator)
        c = torch.tensor(x).float()
        choice = best_choice(network, (c, y), (c[:150], y[:150]), (0.6, 1.0))
        network.keep(torch.from_numpy(choice.points))
        codebook, scale = network.codebook(c, torch.tensor(choice.kappa)), network.scale(c)
    assert codebook.shape == (500, len(choice.points), 2)
    codebook, scale = codebook.double().numpy(), scale.double().numpy()
    scores = scaled_distances(codebook, scale, y)
    radius = conformal_quantile(scores[:400], 0.9)
    assert (scores[400:] <= radius).mean() > 0.8
    # The decoder is continuous, so the region may bridge the gap but must not fill it.
    across = generator.uniform(-1.0, 1.0, y.shape) * (0.7 + 2.0 * x)
    between = np.abs(across).max(axis=1) < 0.5 + 2.0 * x[:, 0]
    assert (scaled_distances(codebook, scale, across)[between] <= radius).mean() < 0.1


def test_the_scale_follows_what_the_condition_says_of_the_spread():
    def spread(count, generator):
        x = generator.uniform(0.0, 1.0, (count, 1))
        return x, (0.2 + x) * generator.standard_normal((count, 2))

    network = fitted(spread)
    with torch.no_grad():
        low, high = network.scale(torch.tensor([[0.0], [1.0]])).diagonal(dim1=1, dim2=2)
    assert (high / low > 3.0).all()


def test_a_region_that_is_no_larger_than_its_radius_has_the_volume_of_discs():
    # With one point and no local scale, the region is a disc about it whose radius covers 90 %.
    torch.manual_seed(0)
    network = RegionNetwork(RegionConfig(response=2, condition=1, local_scale=False)).eval()
    c, y = torch.zeros(100, 1), np.random.default_rng(3).standard_normal((100, 2))
    with torch.no_grad():
        centre = network.codebook(c[:1], torch.tensor(1.0))[0, 0].numpy()
    radius = conformal_quantile(np.linalg.norm(y - centre, axis=1), 0.9)
    found = mean_volume(network, c, y, Choice(1.0, np.array([0])))
    assert found == pytest.approx(np.sqrt(np.pi) * radius, rel=1e-4)


def test_points_that_no_response_is_near_are_left_out():
    network = fitted(two_pieces)
    x, y = two_pieces(2000, np.random.default_rng(4))
    c = torch.tensor(x).float()
    chosen = best_choice(network, (c, y), (c[:150], y[:150]), (0.6, 1.0))
    everything = Choice(chosen.kappa, np.arange(385))
    assert 0 < len(chosen.points) < 385
    rows = slice(150, 450)
    left, all_of_it = (mean_volume(network, c[rows], y[rows], z) for z in (chosen, everything))
    assert left < all_of_it


def test_a_codebook_stays_only_where_the_shape_needs_one():
    def leaning(count, generator):
        x = generator.uniform(0.0, 1.0, (count, 1))
        y = (0.2 + x) * generator.standard_normal((count, 2))
        return x, y @ np.array([[1.0, 0.8], [0.0, 0.3]])

    kept = {}
    for make in (leaning, two_pieces):
        network = fitted(make)
        x, y = make(1500, np.random.default_rng(5))
        c = torch.tensor(x).float()
        arguments = (network, (c[:500], y[:500]), (c[:150], y[:150]), (0.6, 1.0))
        thrifty, best = thrifty_choice(*arguments), best_choice(*arguments)
        kept[make] = thrifty.points
        assert len(thrifty.points) <= len(best.points)
        volume, least = (mean_volume(network, c[:150], y[:150], z) for z in (thrifty, best))
        assert volume <= 1.02 * least
    # One ellipse describes a Gaussian but not two separate pieces.
    assert kept[leaning].tolist() == [0]
    assert len(kept[two_pieces]) > 1


def test_the_centre_alone_is_the_same_point_without_its_rays(network, condition):
    everything = network.codebook(condition, torch.tensor(1.5))
    network.keep(torch.tensor([0]))
    assert network.centre_alone
    torch.testing.assert_close(network.codebook(condition, torch.tensor(1.5)), everything[:, :1])
