"""The `hvs` network behind LeRobot's policy interface."""

import dataclasses
import logging
from pathlib import Path
from typing import Any

import torch
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.utils.constants import ACTION, OBS_STATE
from torch import Tensor

from hvs_suite.errors import DatasetError
from hvs_suite.policies.hvs.configuration_hvs import HvsConfig
from hvs_suite.policies.network.dataset import (
    GOAL_NORMAL,
    GOAL_POSITION,
    TARGET_PREFIX,
    calibration_of,
)
from hvs_suite.policies.network.network import (
    IMAGE_PREFIX,
    MEMORY,
    Decision,
    HvsNetwork,
    Sighting,
    action_loss,
    flange_loss,
    sighting_loss,
    target_loss,
)
from hvs_suite.policies.network.rehearsal import drawn_sightings
from hvs_suite.policies.training.checkpoint import write_checkpoint

logger = logging.getLogger(__name__)


@dataclasses.dataclass(frozen=True, eq=False)
class Lesson:
    """What a batch teaches.

    Attributes:
        loss: Scalar to learn from.
        parts: What it is made of, as numbers.
        sightings: Camera name to what its eye made of the batch.
        truths: Camera name to where the target was: u, v, apparent diameter in image widths, and 1
            where it can be seen, (B, 4); empty without keypoint supervision.
    """

    loss: Tensor
    parts: dict[str, float]
    sightings: dict[str, Sighting]
    truths: dict[str, Tensor]


class HvsPolicy(PreTrainedPolicy):
    """Two images and the joints in, seven joint position targets out.

    Args:
        config: Inputs and sizes.
        dataset_meta: Given by LeRobot's factory: a new policy takes the camera calibration from
            that dataset's privileged columns, if it has them.
        **kwargs: What else LeRobot's factory passes; not used.
    """

    config_class = HvsConfig
    name = "hvs"

    def __init__(self, config: HvsConfig, dataset_meta: Any = None, **kwargs: Any) -> None:
        super().__init__(config)
        config.validate_features()
        self.config: HvsConfig = config
        self.network = HvsNetwork(config.shape())
        self._warned = False
        self._memory: Tensor | None = None
        if dataset_meta is not None and not config.pretrained_path:
            self._calibrate_from(Path(dataset_meta.root))

    def _calibrate_from(self, root: Path) -> None:
        try:
            self.network.set_calibration(calibration_of(root))
        except DatasetError as error:
            logger.warning("no camera calibration from this dataset: %s", error)

    def get_optim_params(self) -> Any:
        """All parameters, in one group."""
        return self.parameters()

    def reset(self) -> None:
        """Forget where the target was seen: a new episode begins."""
        self._memory = None

    def forward(self, batch: dict[str, Tensor]) -> tuple[Tensor, dict[str, float]]:
        """Loss of a batch; LeRobot's interface to `supervise`.

        Args:
            batch: As `supervise` takes it.

        Returns:
            The loss, and its parts as numbers.
        """
        lesson = self.supervise(batch)
        return lesson.loss, lesson.parts

    def supervise(self, batch: dict[str, Tensor]) -> Lesson:
        """Compare the network's output for a batch with the truth.

        Args:
            batch: The inputs (images uint8, or float in [0, 1]), ``action`` (B, 7), and where the
                dataset has them ``privileged.target_<camera>`` (B, 4),
                ``privileged.goal_position`` and ``privileged.goal_normal`` (B, 3); ``memory``
                (B, 4 n + 10) what a policy with n cameras remembers, nothing if it is missing.

        Returns:
            The loss, and what else can be learned from it.
        """
        images, state = self._inputs(batch)
        decision = self.network(images, state, batch.get(MEMORY))
        loss, parts = self._control_loss(decision, batch, state)
        weight = self.config.keypoint_weight
        truths = self._truths(batch) if weight > 0 else {}
        for camera, truth in truths.items():
            part = sighting_loss(decision.sightings[camera], truth)
            parts[f"{camera}_loss"] = part.detach()
            loss = loss + weight * part
        target = decision.target
        if weight > 0 and target is not None and GOAL_POSITION in batch and GOAL_NORMAL in batch:
            place = batch[GOAL_POSITION] - self.network.standoff * batch[GOAL_NORMAL]
            part = target_loss(target, place, self.config.error_scale)
            parts["target_loss"] = part.detach()
            loss = loss + 0.1 * weight * part
        if self.training and weight > 0 and not truths and not self._warned:
            logger.warning(
                "training without keypoint supervision: the batch has no `privileged.target_*`"
            )
            self._warned = True
        numbers = {name: part.item() for name, part in parts.items()}
        return Lesson(loss, numbers, decision.sightings, truths)

    def rehearse(
        self, batch: dict[str, Tensor], lesson: Lesson, generator: torch.Generator
    ) -> Tensor:
        """Loss of the head on frames without images, see `hvs_suite.policies.network.rehearsal`.

        Args:
            batch: As in `supervise`, images left out.
            lesson: From other frames: what the eyes saw in those decides what they would have seen
                in these.
            generator: For the draws.

        Returns:
            The loss; 0 if the batch does not tell where the targets are.
        """
        state = batch[OBS_STATE] if self.network.shape.state_dim else None
        if set(lesson.truths) != set(self.network.shape.cameras) or state is None:
            return self.network.step_gain.new_zeros(())
        drawn = drawn_sightings(lesson.sightings, lesson.truths, self._truths(batch), generator)
        decision = self.network.decide(drawn, state, batch.get(MEMORY))
        return self._control_loss(decision, batch, state)[0]

    def _control_loss(
        self, decision: Decision, batch: dict[str, Tensor], state: Tensor | None
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Loss of the expert's step, joint by joint and at the flange, and its parts."""
        label = self.network.encode_label(batch[ACTION], self._origin(decision, state))
        loss = action_loss(decision.out, label)
        parts = {"action_loss": loss.detach()}
        if (
            self.config.keypoint_weight > 0
            and decision.motion is not None
            and GOAL_POSITION in batch
            and GOAL_NORMAL in batch
        ):
            astray = self.network.to_step(decision.out) - self.network.to_step(label)
            distance = batch[GOAL_POSITION] - decision.motion.position
            part = flange_loss(
                astray,
                decision.motion,
                distance.norm(dim=1, keepdim=True),
                self.config.error_scale,
            )
            parts["flange_loss"] = part.detach()
            loss = loss + 0.3 * part
        return loss, parts

    def _origin(self, decision: Decision, state: Tensor | None) -> Tensor | None:
        if state is None or decision.memory is None:
            return None
        return self.network.origin(state, decision.memory)

    def _truths(self, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        """Where the target is in each camera's images, as far as the batch tells."""
        keys = {camera: TARGET_PREFIX + camera for camera in self.network.shape.cameras}
        return {camera: batch[key] for camera, key in keys.items() if key in batch}

    @torch.no_grad()
    def predict_action_chunk(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """Chunk of one action, (B, 1, 7) in [-1, 1]; one call an observation, for its memory."""
        self.eval()
        images, state = self._inputs(batch)
        if self._memory is not None and len(self._memory) != len(next(iter(images.values()))):
            self._memory = None  # Other environments than before.
        decision = self.network(images, state, self._memory)
        action = self.network.to_action(decision.out, self._origin(decision, state))
        if decision.memory is not None:
            self._memory = self.network.commanded(decision.memory, action)
        return action[:, None]

    @torch.no_grad()
    def select_action(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """Joint position targets in units of the joint range, (B, 7) in [-1, 1].

        Args:
            batch: Images (B, C, H, W) in [0, 1] and the state (B, 14) in rad and rad/s; other
                keys are not looked at.
            **kwargs: What LeRobot passes to policies with random actions; not used.

        Returns:
            The action.
        """
        return self.predict_action_chunk(batch)[:, 0]

    def _inputs(self, batch: dict[str, Tensor]) -> tuple[dict[str, Tensor], Tensor | None]:
        images = {name: batch[IMAGE_PREFIX + name] for name in self.network.shape.cameras}
        return images, batch[OBS_STATE] if self.network.shape.state_dim else None


def save_checkpoint(policy: HvsPolicy, folder: Path) -> None:
    """Write a checkpoint that LeRobot and the suite load, each file whole or not at all.

    Args:
        policy: The policy.
        folder: Gets ``config.json``, ``model.safetensors`` and the two processors.

    Raises:
        OutputError: It cannot be written; what stood there before still does.
    """
    from hvs_suite.policies.hvs.processor_hvs import make_hvs_pre_post_processors

    write_checkpoint(policy, make_hvs_pre_post_processors(policy.config), folder)
