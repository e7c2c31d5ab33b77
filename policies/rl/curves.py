"""SB3's figures as TensorBoard curves that a resumed run does not draw twice."""

from typing import Any

from stable_baselines3.common.logger import KVWriter

from hvs_suite.policies.training.curves import Curves


class LoggedCurves(KVWriter):
    """What SB3's logger writes to; unlike SB3's own writer, it cuts off a lost sitting.

    Args:
        curves: Of this sitting.
    """

    def __init__(self, curves: Curves) -> None:
        self._curves = curves

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
        self._curves.add({k: v for k, v in key_values.items() if isinstance(v, int | float)}, step)

    def close(self) -> None:
        """Nothing to do: the run closes its curves itself."""
