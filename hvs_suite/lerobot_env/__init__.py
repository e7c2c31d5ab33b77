r"""The named tasks as a LeRobot environment: ``--env.type=hvs``.

    lerobot-eval --env.discover_packages_path=hvs_suite.lerobot_env --env.type=hvs \
        --env.task=align-thesis --policy.path=DIR

Importing this package registers the type. It imports LeRobot, which takes some seconds.
"""

from hvs_suite.lerobot_env.configuration import HvsEnvConfig

__all__ = ["HvsEnvConfig"]
