"""The named tasks as a LeRobot environment: ``--env.type=hvs``.

    OMP_NUM_THREADS=1 lerobot-eval --env.type=hvs --env.task=align-thesis --policy.path=DIR

LeRobot finds the type by the distribution ``lerobot_env_hvs`` (in ``integrations/``), or, without
it, by ``--env.discover_packages_path=hvs_suite.lerobot_env``. Importing this package registers the
type, and those of the suite's own policies with it: LeRobot does not accept
``--policy.discover_packages_path`` beside ``--policy.path``. It imports LeRobot, which takes some
seconds.
"""

import hvs_suite.policies.hvs  # noqa: F401 - registers the policy's type
from hvs_suite.lerobot_env.configuration import HvsEnvConfig

__all__ = ["HvsEnvConfig"]
