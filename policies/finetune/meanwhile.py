"""Environments that play while their learner learns: neither waits for the other."""

from collections.abc import Callable

from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn


class Meanwhile(VecEnv):
    """What both kinds have in common.

    Attributes:
        meanwhile: Called once a step, between action and result; None before anyone has said what.
    """

    meanwhile: Callable[[], None] | None = None

    def step_wait(self) -> VecEnvStepReturn:
        """Call it, then wait for the result; SB3's interface."""
        if self.meanwhile is not None:
            self.meanwhile()
        return super().step_wait()  # type: ignore[safe-super]


class MeanwhileHere(Meanwhile, DummyVecEnv):
    """One environment, in this process: it plays after what is done meanwhile."""


class MeanwhileThere(Meanwhile, SubprocVecEnv):
    """Environments in processes of their own, which play during what is done meanwhile."""
