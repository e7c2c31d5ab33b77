"""What the head is taught by: a proposal that was right is found, however sure of another it is."""

import torch

from hvs_suite.policies.belief.control_loss import choice_loss
from hvs_suite.policies.belief.network import OUT_BOUNDS, Decision

PROPOSALS = torch.tensor([[[0.0] * 7, [5.0] * 7]])


def decision(weights: torch.Tensor) -> Decision:
    return Decision(PROPOSALS[:, 0], PROPOSALS, weights)


def test_the_right_proposal_costs_least() -> None:
    label = PROPOSALS[:, 1]
    right, wrong = (
        choice_loss(decision(torch.tensor([weights])), label)
        for weights in ([-4.0, 4.0], [4.0, -4.0])
    )
    assert right < 0.01 < wrong


def test_a_head_that_is_as_sure_as_it_can_be_and_wrong_still_learns() -> None:
    sure = OUT_BOUNDS[2]
    weights = torch.tensor([[sure, -sure]], requires_grad=True)
    choice_loss(decision(weights), PROPOSALS[:, 1]).backward()
    assert weights.grad is not None
    assert weights.grad[0, 1] < -0.9
