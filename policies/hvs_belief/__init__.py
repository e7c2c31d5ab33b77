"""The policy with a belief as a LeRobot policy: configuration, modeling, processor.

Importing this package registers the type ``hvs_belief``, after which LeRobot's own
``PreTrainedConfig.from_pretrained(folder)`` reads its checkpoints; LeRobot's tools import it with
``--policy.discover_packages_path=hvs_suite.policies.hvs_belief``.
"""

from hvs_suite.policies.hvs_belief.configuration_hvs_belief import HvsBeliefConfig
from hvs_suite.policies.hvs_belief.modeling_hvs_belief import HvsBeliefPolicy
from hvs_suite.policies.hvs_belief.processor_hvs_belief import make_hvs_belief_pre_post_processors

__all__ = ["HvsBeliefConfig", "HvsBeliefPolicy", "make_hvs_belief_pre_post_processors"]
