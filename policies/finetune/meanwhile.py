"""Environments that play while their learner learns: neither waits for the other."""

from collections.abc import Callable

from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn


def _nothing() -> None:
    """What is done meanwhile before anyone has said what."""


class MeanwhileHere(DummyVecEnv):
    """One environment, in this process: it plays after what is done meanwhile.

    Attributes:
        meanwhile: Called once a step, between action and result.
    """

    meanwhile: Callable[[], None] = staticmethod(_nothing)

    def step_wait(self) -> VecEnvStepReturn:
        """Call it, then play; SB3's interface."""
        self.meanwhile()
        return super().step_wait()


class MeanwhileThere(SubprocVecEnv):
    """Environments in processes of their own, which play during what is done meanwhile.

    Attributes:
        meanwhile: Called once a step, between action and result.
    """

    meanwhile: Callable[[], None] = staticmethod(_nothing)

    def step_wait(self) -> VecEnvStepReturn:
        """Call it while they play, then wait for them; SB3's interface."""
        self.meanwhile()
        return super().step_wait()
