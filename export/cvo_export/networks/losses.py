"""Loss terms with their sources; the joint loss is the paper's Eq. 4 to 6.

All take standardised numbers of shape (batch, dof) and return a scalar.
"""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor, nn

IntervalForm = Literal["proper", "mean", "sum"]
Gate = Literal["corrected", "literal"]

# The paper's percentiles, 5 % and 95 %, bound a 90 % interval.
LOW, HIGH = 0.05, 0.95
COVERAGE = HIGH - LOW

# Penalty per unit of distance outside. ``proper``: 2/alpha for 90 %. The paper scores the interval
# at alpha = .05 and at alpha = .95 and takes the mean, (40 + 2.105) / 2; the authors' later public
# code adds the two penalties. The minimiser covers 1 - 2/c: 90 %, 90.5 %, 95.25 %.
_PENALTY: dict[IntervalForm, float] = {
    "proper": 2.0 / (1.0 - COVERAGE),
    "mean": (2.0 / LOW + 2.0 / HIGH) / 2.0,
    "sum": 2.0 / LOW + 2.0 / HIGH,
}


def interval_score_loss(lower: Tensor, upper: Tensor, y: Tensor, form: IntervalForm) -> Tensor:
    """INTSCORE, Eq. 4 (Winkler 1972; Gneiting and Raftery 2007, eq. 43)."""
    outside = torch.relu(lower - y) + torch.relu(y - upper)
    return ((upper - lower) + _PENALTY[form] * outside).mean()


def pinball_loss(quantile: Tensor, y: Tensor, tau: float) -> Tensor:
    """Koenker and Bassett 1978: the tau quantile of y minimises it; any one shape -> scalar."""
    above = y - quantile
    return torch.maximum(tau * above, (tau - 1.0) * above).mean()


def kl_divergence(mu: Tensor, log_variance: Tensor) -> Tensor:
    """KL of N(mu, exp(log_variance)) from N(0, I): summed over the latent, mean over the batch."""
    return -0.5 * (1 + log_variance - mu**2 - log_variance.exp()).sum(dim=1).mean()


class CombinedCalibrationLoss(nn.Module):
    """COMCAL, Eq. 5c: (1 - lambda) * CAL + lambda * SHARP, per degree of freedom.

    ``corrected`` (default): each bound is gated by *its own* coverage (Chung et al. 2021): if
    P(y <= Q) is too small, the truths above Q pull it up, otherwise those below pull it down; SHARP
    counts only while the interval covers more than 90 %. The coverages are running means, because
    coverages of a single batch of 64 bias the bounds inwards.

    ``literal``: Eq. 5a and 5b as printed, both bounds gated by the *interval's* coverage of the
    batch: under-coverage raises the lower bound along with the upper one. Kept for comparison.
    """

    def __init__(self, dof: int, sharpness: float, gate: Gate, rate: float = 0.01) -> None:
        super().__init__()
        self.sharpness = sharpness
        self.gate = gate
        self.rate = rate
        self.register_buffer("below_lower", torch.full((dof,), LOW))
        self.register_buffer("below_upper", torch.full((dof,), HIGH))
        self.register_buffer("inside", torch.full((dof,), COVERAGE))
        self.below_lower: Tensor
        self.below_upper: Tensor
        self.inside: Tensor

    @torch.no_grad()
    def observe(self, lower: Tensor, upper: Tensor, y: Tensor) -> None:
        """Move the running coverages towards the coverages of a batch."""
        for running, hits in (
            (self.below_lower, y <= lower),
            (self.below_upper, y <= upper),
            (self.inside, (lower <= y) & (y <= upper)),
        ):
            running.lerp_(hits.to(running.dtype).mean(dim=0), self.rate)

    def forward(self, lower: Tensor, upper: Tensor, y: Tensor) -> Tensor:
        """Shapes (batch, dof) each -> scalar; in training mode, updates the coverages first."""
        if self.training:
            self.observe(lower, upper, y)
        width = upper - lower
        if self.gate == "literal":
            covered = ((lower <= y) & (y <= upper)).to(y.dtype).mean(dim=0)
            calibration = _pull(lower, y, covered < COVERAGE) + _pull(upper, y, covered < COVERAGE)
            sharp = width
        else:
            calibration = _pull(lower, y, self.below_lower < LOW)
            calibration = calibration + _pull(upper, y, self.below_upper < HIGH)
            sharp = width * (self.inside > COVERAGE)
        return (1 - self.sharpness) * calibration.mean() + self.sharpness * sharp.mean()


def _pull(bound: Tensor, y: Tensor, up: Tensor) -> Tensor:
    """Mean distance to the truths above the bound if ``up``, otherwise below it, (dof,)."""
    return torch.where(up, torch.relu(y - bound), torch.relu(bound - y)).mean(dim=0)
