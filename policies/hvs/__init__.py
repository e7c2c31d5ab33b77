"""The `hvs` policy as a LeRobot policy: configuration, modeling, processor.

Importing this package registers the type ``hvs``, after which LeRobot's own
``PreTrainedConfig.from_pretrained(folder)`` reads its checkpoints; LeRobot's tools import it with
``--policy.discover_packages_path=hvs_suite.policies.hvs``.
"""

from hvs_suite.policies.hvs.configuration_hvs import HvsConfig
from hvs_suite.policies.hvs.modeling_hvs import HvsPolicy
from hvs_suite.policies.hvs.processor_hvs import make_hvs_pre_post_processors

__all__ = ["HvsConfig", "HvsPolicy", "make_hvs_pre_post_processors"]
