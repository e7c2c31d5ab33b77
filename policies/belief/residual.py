"""What reinforcement learning adds to an imitated policy: by feel, it moves the believed goal.

A residual in the joints would have to learn the arm. This one is three lengths in the goal's frame,
which are added, step by step, to where the goal is taken to be; eyes, belief and head stay as they
are, and go to the goal that was moved as they would to any. It acts near the goal alone: what was
seen from afar nothing felt can better.

Feeling is about the last steps: how the tip and its set point went, and what the wrench was.
"""

import torch
from torch import Tensor, nn

N_LENGTHS = 3
"""Sideways along the tool's two axes, and along the normal."""
FRAMES = 4
FRAME_SIZE = 12
"""Places of the tip and of its set point (m, base frame), force and torque (flange axes)."""
SHIFT, CLOCK, HISTORY = slice(0, 3), slice(3, 4), slice(4, 4 + FRAMES * FRAME_SIZE)
"""What is remembered: by how much the goal was moved (m, base frame), the time since the beginning
of the episode (s), and the last frames, latest first."""
RESIDUAL_SIZE = 4 + FRAMES * FRAME_SIZE
INPUTS = FRAMES * FRAME_SIZE + N_LENGTHS + 1
"""What the residual reads beside what the head does."""
MOST_STEPS = 10.0
"""A goal is moved by no more than so many of the largest steps, in each direction."""
FINE_M, FINE_N, FINE_NM = 0.001, 5.0, 0.25
"""Below these, lengths, forces and torques weigh linearly, above logarithmically."""
LONG_S = 10.0


def goal_axes(rotation: Tensor, normal: Tensor) -> Tensor:
    """Axes by the goal: the tool's two sideways ones made level with the surface, and the normal.

    Args:
        rotation: Of the tool, (B, 3, 3).
        normal: (B, 3).

    Returns:
        Orthonormal columns, (B, 3, 3).
    """
    x = rotation[:, :, 0]
    x = x - normal * (normal * x).sum(dim=1, keepdim=True)
    x = x / x.norm(dim=1, keepdim=True).clamp(min=1e-6)
    return torch.stack([x, torch.linalg.cross(x, normal, dim=1), normal], dim=2)


class Residual(nn.Module):
    """Says how to move the goal; nothing before it has learned.

    Attributes:
        n_inputs: Numbers that it reads.

    Args:
        n_inputs: Numbers that the head reads.
        hidden: Width of the two layers.
        step_m: The most that it moves the goal in a step: sideways, and along the normal (m).
        reach_m: How far from the believed goal the tip may be for the goal to be moved (m).
        period_s: Control period (s).
    """

    step: Tensor

    def __init__(
        self,
        n_inputs: int,
        hidden: int,
        step_m: tuple[float, float],
        reach_m: float,
        period_s: float,
    ) -> None:
        super().__init__()
        self.n_inputs = n_inputs + INPUTS
        last = nn.Linear(hidden, N_LENGTHS)
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)
        self.layers = nn.Sequential(
            nn.Linear(self.n_inputs, hidden), nn.SiLU(),
            nn.Linear(hidden, hidden), nn.SiLU(),
            last, nn.Tanh(),
        )  # fmt: skip
        sideways, along = step_m
        self.register_buffer(
            "step", torch.tensor([sideways, sideways, along], dtype=torch.float64), persistent=False
        )
        self._reach_m, self._period_s = reach_m, period_s

    def forward(self, inputs: Tensor) -> Tensor:
        """Shares of the largest step, (B, 3) in [-1, 1], by what `inputs` returns."""
        return self.layers(inputs)

    def remember(self, memory: Tensor, tip: Tensor, sent: Tensor, felt: Tensor | None) -> Tensor:
        """Take a control step into the memory.

        Args:
            memory: Its part of it, (B, `RESIDUAL_SIZE`).
            tip: Where the tip is, (B, 3) m.
            sent: Where it was sent, (B, 3) m.
            felt: Wrench, (B, 6); None without.

        Returns:
            As ``memory``.
        """
        wrench = tip.new_zeros(len(tip), 6) if felt is None else felt
        present = torch.cat([tip, sent, wrench], dim=1).to(memory)
        begun = memory[:, CLOCK] > 0
        past = torch.where(begun, memory[:, HISTORY], present.repeat(1, FRAMES))
        clock = memory[:, CLOCK] + self._period_s
        return torch.cat([memory[:, SHIFT], clock, present, past[:, :-FRAME_SIZE]], dim=1)

    def inputs(self, memory: Tensor, read: Tensor, goal: Tensor, axes: Tensor) -> Tensor:
        """What the residual reads.

        Args:
            memory: With this step in it, (B, `RESIDUAL_SIZE`).
            read: What the head reads, (B, k).
            goal: Where it is believed to be, not moved, (B, 3) m.
            axes: Of `goal_axes`.
        """
        frames = memory[:, HISTORY].view(-1, FRAMES, FRAME_SIZE)
        tip, sent = frames[:, :, :3], frames[:, :, 3:6]
        by_goal = (tip - goal[:, None]) @ axes
        ahead = (sent - tip) @ axes
        shift = (memory[:, None, SHIFT] @ axes)[:, 0]
        parts = [
            torch.asinh(by_goal / FINE_M),
            torch.asinh(ahead / FINE_M),
            torch.asinh(frames[:, :, 6:9] / FINE_N),
            torch.asinh(frames[:, :, 9:] / FINE_NM),
        ]
        felt = torch.cat(
            [*(each.flatten(1) for each in parts), shift / self.step, memory[:, CLOCK] / LONG_S],
            dim=1,
        )
        return torch.cat([read, felt.float()], dim=1)

    def is_near(self, memory: Tensor, goal: Tensor) -> Tensor:
        """Whether the tip is so near to the believed goal that it may be moved, (B, 1) bool."""
        tip = memory[:, HISTORY][:, :3]
        return (tip - goal).norm(dim=1, keepdim=True) < self._reach_m

    def move(self, memory: Tensor, share: Tensor, goal: Tensor, axes: Tensor) -> Tensor:
        """Move the goal.

        Args:
            memory: With this step in it, (B, `RESIDUAL_SIZE`).
            share: Of the largest step, (B, 3); clipped to [-1, 1].
            goal: As `inputs` takes it.
            axes: Of `goal_axes`.

        Returns:
            As ``memory``.
        """
        by = share.clamp(-1.0, 1.0).double() * self.step
        most = MOST_STEPS * self.step
        # What was found at one goal says nothing of the next.
        shift = ((memory[:, None, SHIFT] @ axes)[:, 0] + by) * self.is_near(memory, goal)
        shift = torch.maximum(torch.minimum(shift, most), -most)
        return torch.cat([(axes @ shift[:, :, None])[:, :, 0], memory[:, CLOCK.start :]], dim=1)
