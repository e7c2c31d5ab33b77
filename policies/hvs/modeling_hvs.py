"""The network with a belief behind LeRobot's policy interface."""

from pathlib import Path
from typing import Any

import torch
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.utils.constants import ACTION, OBS_STATE
from torch import Tensor

from hvs_suite.datasets.features import IMAGES
from hvs_suite.policies.belief.acting import act
from hvs_suite.policies.belief.cell_model import cell_model
from hvs_suite.policies.belief.eye import SIGHTING_SIZE
from hvs_suite.policies.belief.foresight import PAST_STEPS
from hvs_suite.policies.belief.lessons import Window, eye_lesson, window_lesson
from hvs_suite.policies.belief.network import N_JOINTS, BeliefNetwork
from hvs_suite.policies.belief.prior import take_prior
from hvs_suite.policies.belief.recorded import Recorded, recorded, recorded_keys
from hvs_suite.policies.belief.settings import as_numbers
from hvs_suite.policies.hvs.configuration_hvs import HvsConfig
from hvs_suite.policies.trained_for import trained_for
from hvs_suite.policies.training.checkpoint import write_checkpoint
from hvs_suite.policies.training.dataset import (
    FURTHER_KEYS,
    Manifest,
    read_columns,
    read_manifest,
)
from hvs_suite.registry import find

INDEX = "index"
PADDED = f"{OBS_STATE}_is_pad"


class HvsPolicy(PreTrainedPolicy):
    """Images, joints, goal and wrench in, seven joint position targets out.

    Args:
        config: Inputs and sizes.
        dataset_meta: Of the dataset that is to be learned from, which LeRobot's factory gives. A
            new policy takes from it what it is trained for, the cell and the prior of its belief;
            and every policy what training alone may see, which LeRobot makes no windows of.
        **kwargs: What else LeRobot's factory passes; not used.

    Raises:
        ValueError: The network cannot read these inputs, or the description of the cell is missing.
        DatasetError: The dataset was not recorded by this suite, or is damaged.
    """

    config_class = HvsConfig
    name = "hvs"

    def __init__(self, config: HvsConfig, dataset_meta: Any = None, **kwargs: Any) -> None:
        super().__init__(config)
        self.config: HvsConfig = config
        is_new = not config.pretrained_path
        manifest = None if dataset_meta is None else read_manifest(Path(dataset_meta.root))
        if is_new:
            config.name_inputs()
            if manifest is not None:
                _take_over(config, manifest)
        config.validate_features()
        self.network: BeliefNetwork = config.settings().network()
        self._recorded: Recorded | None = None
        self._memory: Tensor | None = None
        if manifest is not None:
            self._learn_of(manifest, with_prior=is_new)

    def _learn_of(self, manifest: Manifest, *, with_prior: bool) -> None:
        cameras, period_s = tuple(self.network.shape.cameras), self.config.control_period_s
        further = [key for key in FURTHER_KEYS if key in manifest.features]
        columns = read_columns(manifest, [*recorded_keys(cameras), *further])
        self._recorded = recorded(columns, cameras, period_s)
        if with_prior:
            take_prior(self.network, columns)

    def get_optim_params(self) -> Any:
        """All parameters, in one group."""
        return self.parameters()

    def reset(self) -> None:
        """Forget what is believed: a new episode begins."""
        self._memory = None

    def forward(self, batch: dict[str, Tensor]) -> tuple[Tensor, dict[str, float]]:
        """Loss of a batch of windows: the memory goes through each, and is trained with the rest.

        Each window begins with a fresh belief, wherever in its episode. What belief and head make
        of the sightings does not reach the eyes, which learn from where the target is.

        Args:
            batch: The inputs (B, T, ...), images uint8, or float in [0, 1], and ``action``
                (B, T, 7); ``observation.state_is_pad`` (B, T), true for frames before the beginning
                of the episode, none if it is missing; ``index`` (B,), the last frame's number in
                the dataset.

        Returns:
            The loss, and its parts as numbers.

        Raises:
            ValueError: The policy was made without a dataset.
        """
        if self._recorded is None:
            raise ValueError("training needs `dataset_meta`, whose columns say where the goal is")
        network = self.network
        state = batch[OBS_STATE]
        n, length = state.shape[:2]
        padded = batch.get(PADDED, torch.zeros_like(state[:, :, 0], dtype=torch.bool))
        # LeRobot's windows end with a certain frame, lessons begin with one.
        order = (
            torch.arange(n, device=state.device)[:, None],
            padded.int().argsort(dim=1, stable=True),
        )
        counts = ~padded[order]
        before = torch.arange(1 - length, 1, device=state.device)
        rows = (batch[INDEX].reshape(n, 1) + before)[order].clamp(min=0)
        truth = self._recorded.at(rows.cpu()).to(state.device)
        inputs = {
            key: value[order]
            for key, value in batch.items()
            if key in self.config.input_features or key == ACTION
        }
        goal, felt = self._further(inputs)
        images = {name: inputs[IMAGES + name][counts] for name in network.shape.cameras}
        seen = network.see(images, None if goal is None else goal[counts])
        eyes, of_eyes = eye_lesson(
            network, seen, inputs[OBS_STATE][counts][:, :N_JOINTS], truth.at(counts)
        )
        windows = {}
        for name, each in seen.items():
            windows[name] = each.sighting.new_zeros(n, length, SIGHTING_SIZE)
            windows[name][counts] = each.sighting.detach()
        window = Window(
            memory=network.start(n),
            sightings=windows,
            state=inputs[OBS_STATE],
            action=inputs[ACTION],
            truth=truth,
            felt=felt,
            counts=counts,
        )
        rest, of_rest = window_lesson(network, window)
        return eyes + rest, {k: v.detach().item() for k, v in {**of_eyes, **of_rest}.items()}

    def _further(self, batch: dict[str, Tensor]) -> tuple[Tensor | None, Tensor | None]:
        """Which target is meant, and the wrench, of those policies that are told."""
        goal, wrench = (
            None if key is None else batch[key].float()
            for key in (self.config.goal_key, self.config.wrench_key)
        )
        return goal, wrench

    @torch.no_grad()
    def predict_action_chunk(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """Chunk of one action, (B, 1, 7) in [-1, 1]; one call an observation, for its memory."""
        self.eval()
        state = batch[OBS_STATE]
        if self._memory is None or len(self._memory) != len(state):
            # A new episode, or other environments than before.
            self._memory = self.network.start(len(state))
        # LeRobot's pre-processor makes batches of one of states and images alone.
        goal, felt = (
            None if vector is None else vector.reshape(len(state), -1)
            for vector in self._further(batch)
        )
        action, self._memory = act(
            self.network,
            {name: batch[IMAGES + name] for name in self.network.shape.cameras},
            state,
            self._memory,
            goal,
            felt,
        )
        return action[:, None]

    @torch.no_grad()
    def select_action(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """Joint position targets in units of the joint range, (B, 7) in [-1, 1].

        Args:
            batch: Images (B, C, H, W) in [0, 1], the state (B, 14) in rad and rad/s, and what else
                are inputs; other keys are not looked at.
            **kwargs: What LeRobot passes to policies with random actions; not used.

        Returns:
            The action.
        """
        return self.predict_action_chunk(batch)[:, 0]


def _take_over(config: HvsConfig, manifest: Manifest) -> None:
    """Take what a policy is trained for, and its cell, from a dataset."""
    spec = find(manifest.task).with_options(manifest.options)
    for name, value in trained_for(spec).model_dump().items():
        setattr(config, name, value)
    config.cell = as_numbers(cell_model(spec))
    config.foresight = PAST_STEPS if manifest.has_moving_targets else 0
    config.elbow_aside = True


def save_checkpoint(policy: HvsPolicy, folder: Path) -> None:
    """Write a checkpoint that LeRobot and the suite load, each file whole or not at all.

    Args:
        policy: The policy.
        folder: Gets ``config.json``, ``model.safetensors`` and the two processors.

    Raises:
        OutputError: It cannot be written; what stood there before still does.
    """
    from hvs_suite.policies.hvs.processor_hvs import (
        make_hvs_pre_post_processors,
    )

    write_checkpoint(policy, make_hvs_pre_post_processors(policy.config), folder, half=True)
