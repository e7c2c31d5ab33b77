"""The suite as an EnvHub repository: what LeRobot's ``make_env("owner/name")`` imports and calls.

Push this folder to the Hub; hvs-suite itself is installed beside LeRobot (requirements.txt).
"""

from typing import Any

from gymnasium.vector import VectorEnv

from hvs_suite.lerobot_env import HvsEnvConfig

DEFAULT_TASK = "align-easy"


def make_env(
    n_envs: int = 1, use_async_envs: bool = False, cfg: Any = None
) -> dict[str, dict[int, VectorEnv[Any, Any, Any]]]:
    """Makes a vector environment a task.

    Args:
        n_envs: Environments in each.
        use_async_envs: A process each, where there are several.
        cfg: LeRobot's configuration; its ``task`` names a task, a family, or several.

    Returns:
        ``{task: {0: vector environment}}``.
    """
    task = getattr(cfg, "task", None) or DEFAULT_TASK
    return HvsEnvConfig(task=task).create_envs(n_envs, use_async_envs)
