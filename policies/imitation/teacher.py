"""How a network learns from demonstrations: the interface to the training loop."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from hvs_suite.policies.imitation.demonstrations import Demonstrations
from hvs_suite.policies.imitation.settings import Settings

if TYPE_CHECKING:
    from hvs_suite.policies.hvs.modeling_hvs import HvsPolicy
    from hvs_suite.policies.hvs_belief.modeling_hvs_belief import HvsBeliefPolicy

# Philox words that keep this stream apart from others of the same seed.
REHEARSAL_STREAM = 5
HELD_OUT_BATCH = 128
HELD_OUT_FRAMES = 512

Parts = dict[str, float]


class Teacher(Protocol):
    """Teaches one policy."""

    @property
    def policy(self) -> "HvsPolicy | HvsBeliefPolicy":
        """What learns."""

    @property
    def demonstrations(self) -> Demonstrations:
        """What it learns from; DAgger rounds are added to them."""

    def clipped_apart(self) -> list[list[nn.Parameter]]:
        """All parameters, those together whose gradient is clipped as one."""

    def is_due(self, share: float) -> bool:
        """Whether `look_again` is to be called at this part of the training, 0 to 1."""

    def look_again(self, share: float) -> None:
        """Do what takes too long for every step; the result is a function of the weights."""

    def lesson(self, rows: npt.NDArray[np.int64], step: int) -> tuple[Tensor, Parts]:
        """Loss to learn from, and what it is made of.

        Args:
            rows: Frames to learn from.
            step: Number of the optimiser step, which all draws are a function of.
        """

    def held_out(self) -> Parts:
        """Mean losses over held-out episodes, ``loss`` among them; empty if there are none."""

    def save(self, out: Path) -> None:
        """Write the checkpoint."""


def held_out_means(
    policy: nn.Module,
    demonstrations: Demonstrations,
    losses: Callable[[npt.NDArray[np.int64]], Parts],
) -> Parts:
    """Mean losses over frames spread over the held-out episodes; empty if there are none.

    Args:
        policy: In evaluation mode meanwhile.
        demonstrations: Say which episodes are held out.
        losses: Of some frames, by name.
    """
    indices = demonstrations.held_out
    if not len(indices):
        return {}
    spread = np.linspace(0, len(indices) - 1, min(len(indices), HELD_OUT_FRAMES))
    indices = indices[spread.astype(np.int64)]
    sums: Parts = {}
    policy.eval()
    with torch.no_grad():
        for first in range(0, len(indices), HELD_OUT_BATCH):
            some = indices[first : first + HELD_OUT_BATCH]
            for name, value in losses(some).items():
                sums[name] = sums.get(name, 0.0) + value * len(some)
    policy.train()
    return {name: value / len(indices) for name, value in sums.items()}


class FrameTeacher:
    """Teaches `HvsPolicy` from single frames, and its head from more of them without images.

    Args:
        policy: What learns.
        demonstrations: What it learns from.
        settings: Of the run.
    """

    def __init__(
        self, policy: "HvsPolicy", demonstrations: Demonstrations, settings: Settings
    ) -> None:
        self.policy = policy
        self.demonstrations = demonstrations
        self._settings = settings

    def clipped_apart(self) -> list[list[nn.Parameter]]:
        """All at once."""
        return [list(self.policy.parameters())]

    def is_due(self, share: float) -> bool:
        """Never."""
        return False

    def look_again(self, share: float) -> None:
        """Nothing."""

    def lesson(self, rows: npt.NDArray[np.int64], step: int) -> tuple[Tensor, Parts]:
        """As `Teacher.lesson`."""
        taught = self.policy.supervise(self.demonstrations.batch(rows))
        if not self._settings.rehearsal_frames:
            return taught.loss, taught.parts
        key = np.random.Philox(key=[self._settings.seed, REHEARSAL_STREAM], counter=step)
        random = np.random.Generator(key)
        more = random.choice(self.demonstrations.training, self._settings.rehearsal_frames)
        generator = torch.Generator().manual_seed(int(random.integers(2**32)))
        batch = self.demonstrations.batch(more, pictures=False)
        extra = self.policy.rehearse(batch, taught, generator)
        return taught.loss + extra, {**taught.parts, "rehearsal_loss": extra.item()}

    def held_out(self) -> Parts:
        """As `Teacher.held_out`."""

        def losses(rows: npt.NDArray[np.int64]) -> Parts:
            loss, parts = self.policy(self.demonstrations.batch(rows))
            return {"loss": loss.item(), **parts}

        return held_out_means(self.policy, self.demonstrations, losses)

    def save(self, out: Path) -> None:
        """As `Teacher.save`."""
        from hvs_suite.policies.hvs.modeling_hvs import save_checkpoint

        save_checkpoint(self.policy, out)
