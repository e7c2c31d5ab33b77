"""The suite's visuomotor policy as a LeRobot policy: configuration, modeling, processor.

LeRobot's tools find it through ``--policy.discover_packages_path=hvs_suite.policies.hvs``; in
Python, ``from hvs_suite.policies.hvs import HvsPolicy`` registers it, after which LeRobot's own
``PreTrainedConfig.from_pretrained(folder)`` reads its checkpoints too.

The names below are loaded on first use: the network alone (`network`) needs torch, not LeRobot.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hvs_suite.policies.hvs.configuration_hvs import HvsConfig as HvsConfig
    from hvs_suite.policies.hvs.modeling_hvs import HvsPolicy as HvsPolicy
    from hvs_suite.policies.hvs.processor_hvs import (
        make_hvs_pre_post_processors as make_hvs_pre_post_processors,
    )

_HOMES = {
    "HvsConfig": "configuration_hvs",
    "HvsPolicy": "modeling_hvs",
    "make_hvs_pre_post_processors": "processor_hvs",
}
__all__ = ["HvsConfig", "HvsPolicy", "make_hvs_pre_post_processors"]


def __getattr__(name: str) -> Any:
    """Import the module that defines a public name."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
