"""The minimisers of the losses, found by optimisation on samples of known distributions."""

import pytest
import torch

from cvo_export.networks.losses import (
    COVERAGE,
    CombinedCalibrationLoss,
    interval_score_loss,
    kl_divergence,
)


def optimised_bounds(loss_of, steps=1500, n=4000):
    torch.manual_seed(0)
    y = torch.randn(n, 1)
    lower, upper = torch.tensor([-0.5], requires_grad=True), torch.tensor([0.5], requires_grad=True)
    optimiser = torch.optim.Adam([lower, upper], lr=0.02)
    for _ in range(steps):
        batch = y[torch.randint(n, (512,))]
        loss = loss_of(lower.expand_as(batch), upper.expand_as(batch), batch)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    with torch.no_grad():
        inside = ((lower <= y) & (y <= upper)).float().mean().item()
    return lower.item(), upper.item(), inside


@pytest.mark.parametrize(("form", "coverage"), [("proper", 0.9), ("mean", 0.905), ("sum", 0.9525)])
def test_interval_score_is_least_at_its_coverage(form, coverage):
    *_, inside = optimised_bounds(lambda low, high, y: interval_score_loss(low, high, y, form))
    assert inside == pytest.approx(coverage, abs=0.02)


def test_corrected_gate_with_the_interval_score_covers_ninety_percent():
    combined = CombinedCalibrationLoss(1, 0.5, "corrected").train()
    low, high, inside = optimised_bounds(
        lambda lower, upper, y: (
            interval_score_loss(lower, upper, y, "proper") + combined(lower, upper, y)
        )
    )
    assert inside == pytest.approx(COVERAGE, abs=0.02)
    assert low == pytest.approx(-1.645, abs=0.15)
    assert high == pytest.approx(1.645, abs=0.15)


def test_literal_gate_alone_moves_both_bounds_to_one_side():
    literal = CombinedCalibrationLoss(1, 0.0, "literal").train()
    low, high, inside = optimised_bounds(literal)
    assert low > 0.5
    assert high > 1.0
    assert inside < 0.5


def test_sharpness_counts_only_while_coverage_is_above_target():
    combined = CombinedCalibrationLoss(1, 1.0, "corrected").eval()
    lower, upper, y = torch.tensor([[-1.0]]), torch.tensor([[2.0]]), torch.zeros(1, 1)
    combined.inside.fill_(0.95)
    assert combined(lower, upper, y).item() == pytest.approx(3.0)
    combined.inside.fill_(0.85)
    assert combined(lower, upper, y).item() == 0.0


def test_running_coverages_move_only_in_training():
    combined = CombinedCalibrationLoss(2, 0.5, "corrected").eval()
    arguments = torch.full((8, 2), 5.0), torch.full((8, 2), 6.0), torch.zeros(8, 2)
    combined(*arguments)
    assert combined.inside.tolist() == pytest.approx([COVERAGE] * 2)
    combined.train()
    combined(*arguments)
    assert combined.inside.tolist() == pytest.approx([0.99 * COVERAGE] * 2)


def test_divergence_is_zero_at_the_standard_gaussian_and_the_closed_form_elsewhere():
    assert kl_divergence(torch.zeros(4, 3), torch.zeros(4, 3)).item() == 0.0
    mu, log_variance = torch.tensor([[1.0, -2.0]]), torch.tensor([[0.3, -0.7]])
    gaussian = torch.distributions.Normal(mu, (0.5 * log_variance).exp())
    standard = torch.distributions.Normal(torch.zeros(1, 2), torch.ones(1, 2))
    expected = torch.distributions.kl_divergence(gaussian, standard).sum()
    assert kl_divergence(mu, log_variance).item() == pytest.approx(expected.item(), rel=1e-6)
