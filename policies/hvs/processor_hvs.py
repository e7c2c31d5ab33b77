"""Pre- and post-processing of the `hvs` policy: LeRobot's standard steps, nothing to scale.

The pipelines need not carry what training alone may see: LeRobot makes windows of ``observation.*``
and of the action, and of ``privileged.*`` columns it never does, so the policy looks them up in the
dataset by the frames' ``index``, which LeRobot's pipelines do pass on, loaded ones as well.
"""

from typing import Any

import torch
from lerobot.lerobot_types import PolicyAction
from lerobot.processor import PolicyProcessorPipeline, make_default_pre_post_processors

from hvs_suite.policies.hvs.configuration_hvs import HvsConfig


def make_hvs_pre_post_processors(
    config: HvsConfig,
    dataset_stats: dict[str, dict[str, torch.Tensor]] | None = None,
) -> tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]],
    PolicyProcessorPipeline[PolicyAction, PolicyAction],
]:
    """Make the two pipelines, found by LeRobot through this function's name.

    Args:
        config: The policy's configuration.
        dataset_stats: Statistics of the dataset; not kept, because nothing is normalised by them.

    Returns:
        Pre-processor (batch to batch) and post-processor (action to action).
    """
    return make_default_pre_post_processors(config)
