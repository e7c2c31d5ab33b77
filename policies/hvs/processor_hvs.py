"""Pre- and post-processing of the `hvs` policy: LeRobot's standard steps, with nothing to scale.

LeRobot's conversion of a batch to a transition keeps observations, the action and a closed list of
other keys; what training alone may see (``privileged.*``) is not on it. The pipeline made here
carries those along beside the observation. A pipeline that LeRobot *loads* from a checkpoint uses
its own conversion again, so resuming a run with stock ``lerobot-train`` trains on actions alone
(the policy warns); `hvs pretrain` does not go through the pipeline.
"""

from typing import Any

import torch
from lerobot.lerobot_types import EnvTransition, PolicyAction, TransitionKey
from lerobot.processor import (
    PolicyProcessorPipeline,
    batch_to_transition,
    make_default_pre_post_processors,
)

from hvs_suite.policies.hvs.configuration_hvs import HvsConfig

PRIVILEGED_PREFIX = "privileged."


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
    preprocessor, postprocessor = make_default_pre_post_processors(config)
    preprocessor.to_transition = privileged_batch_to_transition
    return preprocessor, postprocessor


def privileged_batch_to_transition(batch: dict[str, Any]) -> EnvTransition:
    """LeRobot's conversion, with the privileged columns beside the observation.

    Args:
        batch: A batch of a dataset.

    Returns:
        The transition; its complementary data hold ``privileged.*``.
    """
    transition = batch_to_transition(batch)
    privileged = {k: v for k, v in batch.items() if k.startswith(PRIVILEGED_PREFIX)}
    known = transition.get(TransitionKey.COMPLEMENTARY_DATA) or {}
    transition[TransitionKey.COMPLEMENTARY_DATA] = {**known, **privileged}
    return transition
