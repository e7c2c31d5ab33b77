"""SB3's figures as TensorBoard curves that a resumed run does not draw twice."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from stable_baselines3.common.logger import KVWriter
from torch.utils.tensorboard import SummaryWriter


class Curves(KVWriter):
    """What SB3's logger writes to; unlike SB3's own writer, it cuts off a lost sitting.

    Args:
        folder: Of the event files.
        env_steps: Where this sitting begins.
    """

    def __init__(self, folder: Path, env_steps: int) -> None:
        # Points of a sitting that was killed lie beyond the step at which its checkpoint was made.
        self._writer = SummaryWriter(str(folder), purge_step=env_steps + 1)

    def write(
        self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0
    ) -> None:
        """Take what SB3 dumps.

        Args:
            key_values: Figures by name; what is no number is left out.
            key_excluded: Not used: what SB3 keeps from TensorBoard are counters worth having.
            step: Environment steps.
        """
        del key_excluded
        self.add({k: v for k, v in key_values.items() if isinstance(v, int | float)}, step)

    def add(self, figures: Mapping[str, float], step: int) -> None:
        """Add a point to each curve.

        Args:
            figures: By name.
            step: Environment steps.
        """
        for name, value in figures.items():
            self._writer.add_scalar(name, float(value), step)
        self._writer.flush()

    def close(self) -> None:
        """Close the event file."""
        self._writer.close()
