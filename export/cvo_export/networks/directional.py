"""Directional quantile regression in the latent space of a conditional variational autoencoder.

Feldman, Bates and Romano 2021 (arXiv 2110.00816). Given a condition c and a response y in R^d, an
autoencoder maps y to z in R^3, where the distribution is close to a ball whatever its shape in R^d.
For each of D directions u on the sphere a network predicts the quantile q(c, u) of u.z, and

    {z : u.z >= q(c, u) for all u}

is a region; decoded, it may be a ring, a banana or two pieces. This module differs from the paper:

- q(c, u) = u.zbar(c) - softplus(h(c, u)) with a centre zbar(c), the conditional mean of z: the
  centre is always inside, whether or not the latent is centred at 0;
- every step trains all directions;
- a lower triangular matrix B(c) with y = B(c) v models the scale and correlation of the responses:
  it is the scale matrix of a multivariate t distribution with 5 degrees of freedom, trained by
  maximum likelihood. The autoencoder works on v;
- the region is a codebook of fixed size instead of a grid: rays from the centre, cut where they
  leave the region and multiplied by kappa, at three shells. ``grid_codebook``, as in the paper,
  serves as a check: all points of a latent grid that lie inside;
- points that are the nearest to hardly any training response are removed if that makes val's
  regions smaller: they lie where the ball in latent space covers a gap, e.g. the middle of a ring;
- if the responses have no such shape, a codebook adds nothing to B(c): ``thrifty_choice`` keeps as
  few points as possible.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.functional import softplus

from cvo_edge.conformal import conformal_quantile
from cvo_export.bundles.volume import union_log_volume
from cvo_export.networks.losses import kl_divergence, pinball_loss

Array = NDArray[np.float64]

LATENT = 3

# Positions of the codebook points along a ray; the centre is an additional point.
SHELLS = (0.35, 0.7, 1.0)
# Inflations of the region, before calibration, that val chooses from.
KAPPAS = (0.2, 0.4, 0.6, 0.8, 1.0, 1.25, 1.5, 2.0)
# A ray nearly parallel to a half-space never leaves it.
_PARALLEL = 1e-3
_LEAST_RADIUS = 1e-3
# Remove a codebook point that is the nearest to less than this fraction of its even share.
_LEAST_SHARE = 0.1
# Accepted increase of volume^(1/d) for a smaller codebook.
_HARDLY = 1.02
_TAIL = 5.0
# Clip responses at this many scales: further out they say nothing about the shape.
_FAR = 20.0


class RegionConfig(NamedTuple):
    """Sizes and weights of the networks.

    Attributes
    ----------
    response, condition
            Dimensions of y and c.
        directions, rays
            D, the number of directions whose quantiles are learned; number of rays of the codebook.
        tau
            Level of the directional quantiles.
        kl_weight
            beta of the autoencoder.
        dropout
            Dropout rate after the hidden layers during training.
        local_scale
            Whether B depends on c; otherwise it is the identity.
    """

    response: int
    condition: int
    directions: int = 128
    rays: int = 128
    tau: float = 0.05
    kl_weight: float = 0.01
    dropout: float = 0.05
    local_scale: bool = True


class RegionNetwork(nn.Module):
    """Scale, autoencoder and directional quantiles of y given c."""

    def __init__(self, config: RegionConfig) -> None:
        super().__init__()
        y, c, dropout = config.response, config.condition, config.dropout
        self.config = config
        lower = torch.tril_indices(y, y, -1)
        place = torch.zeros(lower.shape[1], y * y)
        place[torch.arange(lower.shape[1]), lower[0] * y + lower[1]] = 1.0
        self.register_buffer("place", place)
        self.place: Tensor
        self.spread = _perceptron(c, 64, 64, y + lower.shape[1], dropout=2 * dropout)
        self.encoder = _perceptron(c + y, 128, 128, 2 * LATENT)
        self.decoder = _perceptron(LATENT + c, 64, 128, 64, y, dropout=dropout)
        self.centre = _perceptron(c, 64, LATENT)
        self.distance = _perceptron(c, 64, 64, config.directions, dropout=dropout)
        directions, rays = fibonacci_sphere(config.directions), fibonacci_sphere(config.rays)
        self.register_buffer("directions", directions)
        self.directions: Tensor
        slope = rays @ directions.T
        leaving = torch.where(slope < -_PARALLEL, -1.0 / slope.clamp(max=-_PARALLEL), 1e9)
        self.register_buffer("leaving", leaving)
        self.leaving: Tensor
        shells = torch.cat([torch.zeros(1, LATENT), *(shell * rays for shell in SHELLS)])
        self.register_buffer("shells", shells)
        self.shells: Tensor
        ray = torch.arange(config.rays)
        self.register_buffer("ray", torch.cat([ray[:1], *(ray for _ in SHELLS)]))
        self.ray: Tensor
        # A codebook that consists of the centre only needs no rays.
        self.centre_alone = False

    def scale(self, c: Tensor) -> Tensor:
        """Condition (n, c) -> B (n, d, d), lower triangular with a positive diagonal."""
        d = self.config.response
        if not self.config.local_scale:
            return torch.eye(d).expand(len(c), d, d)
        spread = self.spread(c)
        # Clamp to e^+-4: training data never go beyond.
        diagonal = torch.exp(spread[:, :d].clamp(-4.0, 4.0))
        lean = (spread[:, d:] @ self.place).reshape(-1, d, d)
        scale: Tensor = diagonal[:, :, None] * (lean + torch.eye(d))
        return scale

    def quantile(self, c: Tensor, centre: Tensor) -> Tensor:
        """Condition (n, c), centre (n, 3) -> directional quantiles q (n, D)."""
        quantile: Tensor = centre @ self.directions.T - softplus(self.distance(c))
        return quantile

    def codebook(self, c: Tensor, kappa: Tensor) -> Tensor:
        """Condition (n, c), kappa () -> points of the region in R^d before B, (n, J, d)."""
        z = self.centre(c)[:, None]
        if not self.centre_alone:
            radius = kappa * self._reach(c)
            z = z + radius[:, self.ray, None] * self.shells
        return self._decoded(z, c)

    def keep(self, points: Tensor) -> None:
        """Keep only these points of the codebook; indices in ascending order."""
        self.shells, self.ray = self.shells[points], self.ray[points]
        self.centre_alone = points.tolist() == [0]

    def grid_codebook(self, c: Tensor, side: int = 16) -> tuple[Tensor, Tensor]:
        """All points of a latent grid, decoded, (n, side^3, d), and an inside mask (n, side^3).

        The paper's grid spans the range of training latents; this one spans the reach of the
        region's longest ray. Points outside are moved to the centre.
        """
        centre = self.centre(c)
        reach = self._reach(c)
        axis = torch.linspace(-1.0, 1.0, side)
        unit = torch.cartesian_prod(axis, axis, axis)
        z = centre[:, None] + 1.1 * reach.amax(dim=1)[:, None, None] * unit
        inside = (z @ self.directions.T >= self.quantile(c, centre)[:, None]).all(dim=2)
        z = torch.where(inside[:, :, None], z, centre[:, None])
        return self._decoded(z, c), inside

    def loss(self, c: Tensor, y: Tensor) -> Tensor:
        """Condition (n, c), response (n, d) -> scalar: scale, autoencoder, centre, quantiles.

        Each part learns from the output of the previous one and sends no gradient back.
        """
        scale = self.scale(c)
        v = torch.linalg.solve_triangular(scale, y[:, :, None], upper=False)[:, :, 0]
        loss = _t_likelihood(scale, v) if self.config.local_scale else v.new_zeros(())
        v = v.detach().clamp(-_FAR, _FAR)
        mu, log_variance = self.encoder(torch.cat([c, v], dim=1)).split(LATENT, dim=1)
        log_variance = log_variance.clamp(-10.0, 10.0)
        z = mu + torch.randn_like(mu) * torch.exp(0.5 * log_variance)
        reconstruction = self.decoder(torch.cat([z, c], dim=1))
        loss = loss + (reconstruction - v).square().mean()
        loss = loss + self.config.kl_weight * kl_divergence(mu, log_variance)
        z, centre = z.detach(), self.centre(c)
        loss = loss + (centre - z).square().mean()
        quantile = self.quantile(c, centre.detach())
        loss = loss + pinball_loss(quantile, z @ self.directions.T, self.config.tau)
        return cast("Tensor", loss)

    def _reach(self, c: Tensor) -> Tensor:
        """Condition (n, c) -> length of each ray from the centre to the boundary, (n, rays)."""
        distance = softplus(self.distance(c))[:, None] * self.leaving
        reach: Tensor = distance.amin(dim=2).clamp(min=_LEAST_RADIUS)
        return reach

    def _decoded(self, z: Tensor, c: Tensor) -> Tensor:
        """Latents (n, J, 3) -> points (n, J, d); computes the first layer's product with c once."""
        first = cast("nn.Linear", self.decoder[0])
        of_z, of_c = first.weight[:, :LATENT], first.weight[:, LATENT:]
        hidden = z @ of_z.T + (c @ of_c.T + first.bias)[:, None]
        points: Tensor = self.decoder[1:](hidden)
        return points


class Choice(NamedTuple):
    """Inflation of a region, and the codebook points that are kept, ascending."""

    kappa: float
    points: NDArray[np.int64]


def best_choice(
    network: RegionNetwork,
    train: tuple[Tensor, Array],
    val: tuple[Tensor, Array],
    kappas: Sequence[float] = KAPPAS,
) -> Choice:
    """Return the choice with the smallest regions on val; train and val are c (n, c), y (n, d)."""
    everything = np.arange(len(network.shells))
    choices = [
        Choice(kappa, points)
        for kappa in kappas
        for points in (everything, _used(network, *train, kappa))
    ]
    return min(choices, key=lambda choice: mean_volume(network, *val, choice))


def thrifty_choice(
    network: RegionNetwork,
    train: tuple[Tensor, Array],
    val: tuple[Tensor, Array],
    kappas: Sequence[float] = KAPPAS,
) -> Choice:
    """Return the smallest codebook whose regions on val are hardly larger than the best choice's.

    Every codebook point costs decoder work. The candidates are the centre alone (one ellipsoid) and
    the centre with the outermost shell. Arguments as for ``best_choice``.
    """
    best = best_choice(network, train, val, kappas)
    limit = _HARDLY * mean_volume(network, *val, best)
    rays = network.config.rays
    outermost = np.concatenate([[0], np.arange(len(network.shells) - rays, len(network.shells))])
    choices = [Choice(best.kappa, outermost[:1]), *(Choice(kappa, outermost) for kappa in kappas)]
    volumes = [mean_volume(network, *val, choice) for choice in choices]
    if volumes[0] <= limit:
        return choices[0]
    if min(volumes[1:]) <= limit and len(outermost) < len(best.points):
        return choices[1 + int(np.argmin(volumes[1:]))]
    return best


@torch.no_grad()
def _used(network: RegionNetwork, c: Tensor, y: Array, kappa: float) -> NDArray[np.int64]:
    """Return the points nearest to at least ``_LEAST_SHARE`` of their even share of responses."""
    v = np.linalg.solve(network.scale(c).double().numpy(), y[:, :, np.newaxis])
    responses = torch.from_numpy(v[:, :, 0]).float()
    codebook = network.codebook(c, torch.tensor(kappa))
    nearest = torch.linalg.norm(codebook - responses[:, None], dim=2).argmin(dim=1)
    counts = np.bincount(nearest.numpy(), minlength=codebook.shape[1])
    return np.flatnonzero(counts >= _LEAST_SHARE * len(y) / codebook.shape[1])


@torch.no_grad()
def mean_volume(
    network: RegionNetwork, c: Tensor, y: Array, choice: Choice, draws: int = 400
) -> float:
    """Geometric mean volume of the regions at 90 %, to the power 1/d.

    Condition (n, c) and responses (n, d), which also determine the radius.
    """
    codebook = network.codebook(c, torch.tensor(choice.kappa)).double().numpy()
    codebook, scale = codebook[:, choice.points], network.scale(c).double().numpy()
    radius = conformal_quantile(scaled_distances(codebook, scale, y), 0.9)
    volumes = [union_log_volume(points, radius, row, draws) for row, points in enumerate(codebook)]
    determinants = np.log(np.diagonal(scale, axis1=1, axis2=2)).sum(axis=1)
    return math.exp(float((np.array(volumes) + determinants).mean()) / y.shape[1])


def scaled_distances(codebook: Array, scale: Array, y: Array) -> Array:
    """Codebook (n, J, d) before B, B (n, d, d), y (n, d) -> distance to the nearest point, (n,).

    A single codebook and a single B may serve all y.
    """
    v = np.linalg.solve(scale, y[:, :, np.newaxis])[:, np.newaxis, :, 0]
    return np.asarray(np.linalg.norm(codebook - v, axis=2).min(axis=1))


def fibonacci_sphere(count: int) -> Tensor:
    """Unit vectors (count, 3), spread evenly over the sphere."""
    index = np.arange(count) + 0.5
    height = 1.0 - 2.0 * index / count
    turn = np.pi * (1.0 + math.sqrt(5.0)) * index
    ring = np.sqrt(1.0 - height**2)
    points = np.stack([ring * np.cos(turn), ring * np.sin(turn), height], axis=1)
    return torch.tensor(points, dtype=torch.float32)


def _t_likelihood(scale: Tensor, v: Tensor) -> Tensor:
    """Negative log likelihood per dimension, without constants, of y = B v as multivariate t."""
    d = v.shape[1]
    log_determinant = scale.diagonal(dim1=1, dim2=2).log().sum(dim=1)
    tail = 0.5 * (_TAIL + d) * torch.log1p(v.square().sum(dim=1) / _TAIL)
    return (log_determinant + tail).mean() / d


def _perceptron(*widths: int, dropout: float = 0.0) -> nn.Sequential:
    layers: list[nn.Module] = []
    for inputs, outputs in pairwise(widths):
        layers += [nn.Linear(inputs, outputs), nn.LeakyReLU(0.2)]
        if dropout > 0:
            layers.append(nn.Dropout(dropout))
    last = max(index for index, layer in enumerate(layers) if isinstance(layer, nn.Linear))
    return nn.Sequential(*layers[: last + 1])
