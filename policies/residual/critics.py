"""Critics that see more than the actor."""

import torch
from torch import Tensor, nn

from hvs_suite.policies.belief.residual import N_LENGTHS


class Critics(nn.Module):
    """Two estimates of what an action is worth, of which the lower is believed (TD3).

    Args:
        n_read: Numbers that the actor reads.
        n_privileged: Numbers that only the simulator knows.
        hidden: Width of their two layers.
    """

    def __init__(self, n_read: int, n_privileged: int, hidden: int) -> None:
        super().__init__()
        n = n_read + n_privileged + N_LENGTHS
        self.each = nn.ModuleList(
            nn.Sequential(
                nn.Linear(n, hidden), nn.LayerNorm(hidden), nn.SiLU(),
                nn.Linear(hidden, hidden), nn.LayerNorm(hidden), nn.SiLU(),
                nn.Linear(hidden, 1),
            )
            for _ in range(2)
        )  # fmt: skip

    def forward(self, read: Tensor, privileged: Tensor, action: Tensor) -> Tensor:
        """Both values, (B, 2), of what is read (B, n), seen (B, m), and done (B, 3)."""
        seen = torch.cat([read, privileged, action], dim=1)
        return torch.cat([critic(seen) for critic in self.each], dim=1)
