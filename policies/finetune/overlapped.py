"""Environments that play while their learner learns: neither waits for the other."""

from collections.abc import Callable

from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn


class Overlapped(VecEnv):
    """What both kinds have in common.

    Attributes:
        overlapped: Called once a step, between action and result; None before anyone has said what.
    """

    overlapped: Callable[[], None] | None = None

    def step_wait(self) -> VecEnvStepReturn:
        """Call it, then wait for the result; SB3's interface."""
        if self.overlapped is not None:
            self.overlapped()
        return super().step_wait()  # type: ignore[safe-super]


class OverlappedDummyVecEnv(Overlapped, DummyVecEnv):
    """One environment, in this process: it plays after what is overlapped with it."""


class OverlappedSubprocVecEnv(Overlapped, SubprocVecEnv):
    """Environments in processes of their own, which play during what is overlapped with them."""
