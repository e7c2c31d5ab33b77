"""What policy search adds to an imitated policy on the way: it chooses otherwise.

The head sends a mean of proposals by their weights, and corrects it. Imitation learns both step by
step, and what is between two ways is slower than either; how long a way takes as a whole nothing
tells it. Here the logits of the weights and of the correction's gate are shifted, by how far the
tip is from the goal. Near the goal nothing is shifted, and the arm stays as exact as it was.
"""

import math

import torch
from torch import Tensor, nn

MOST = 4.0
"""A logit is shifted by no more than this."""
FAR_M = 1.0
"""The way is told on a logarithmic scale from where the choice begins (0) to here (1)."""
N_FEATURES = 2
"""A constant, and the way."""


class Choice(nn.Module):
    """Shifts the logits by which the head chooses; by nothing before it has learned.

    Attributes:
        weight: Shifts for each feature, in units of `MOST`, (`N_FEATURES`, n).

    Args:
        n_logits: The gate of the correction, and the weight of each proposal.
        beyond_m: How far from the believed goal the tip has to be (m).
    """

    def __init__(self, n_logits: int, beyond_m: float) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.zeros(N_FEATURES, n_logits))
        self._beyond_m = beyond_m

    def forward(self, way_m: Tensor) -> Tensor:
        """What is added to the logits.

        Args:
            way_m: How far the tip is from the believed goal, (B, 1) m.

        Returns:
            (B, n); 0 near the goal.
        """
        way = torch.log(way_m / self._beyond_m) / math.log(FAR_M / self._beyond_m)
        features = torch.cat([torch.ones_like(way), way.clamp(0.0, 1.0)], dim=1)
        shift = MOST * (features @ self.weight).clamp(-1.0, 1.0)
        return shift * (way_m > self._beyond_m)
