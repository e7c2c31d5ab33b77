"""The network with a belief behind LeRobot's policy interface."""

import logging
from pathlib import Path
from typing import Any

import torch
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.utils.constants import ACTION, OBS_STATE
from torch import Tensor

from hvs_suite.errors import DatasetError
from hvs_suite.policies.belief.acting import act
from hvs_suite.policies.belief.belief import BELIEF_SIZE, View, belief_loss
from hvs_suite.policies.belief.cell_model import cell_model
from hvs_suite.policies.belief.control_loss import TIP_WEIGHT, action_loss, tip_loss
from hvs_suite.policies.belief.eye import SIGHTING_SIZE, sighting_loss
from hvs_suite.policies.belief.network import BEGUN, N_JOINTS, SET_POINT, BeliefNetwork
from hvs_suite.policies.belief.prior import GOAL_VELOCITY, fit_prior
from hvs_suite.policies.belief.recorded import Recorded, recorded, recorded_keys
from hvs_suite.policies.belief.settings import as_numbers
from hvs_suite.policies.hvs_belief.configuration_hvs_belief import HvsBeliefConfig
from hvs_suite.policies.network.dataset import Manifest, read_columns, read_manifest
from hvs_suite.policies.network.geometry import flange_motion
from hvs_suite.policies.network.network import IMAGE_PREFIX
from hvs_suite.policies.trained_for import trained_for
from hvs_suite.policies.training.checkpoint import write_checkpoint
from hvs_suite.registry import find

logger = logging.getLogger(__name__)

INDEX = "index"
PADDED = f"{OBS_STATE}_is_pad"


class HvsBeliefPolicy(PreTrainedPolicy):
    """Images, joints, goal and wrench in, seven joint position targets out.

    Args:
        config: Inputs and sizes.
        dataset_meta: Given by LeRobot's factory. A new policy takes from that dataset what it was
            recorded for, the cell and the prior of its belief; and every policy what training alone
            may see, which LeRobot makes no windows of.
        **kwargs: What else LeRobot's factory passes; not used.

    Raises:
        ValueError: The network cannot read these inputs, or nobody says what the cell is.
    """

    config_class = HvsBeliefConfig
    name = "hvs_belief"

    def __init__(self, config: HvsBeliefConfig, dataset_meta: Any = None, **kwargs: Any) -> None:
        super().__init__(config)
        self.config: HvsBeliefConfig = config
        manifest = _manifest(dataset_meta)
        is_new = not config.pretrained_path
        if is_new:
            config.name_inputs()
            if manifest is not None:
                _take_over(config, manifest)
        config.validate_features()
        self.network: BeliefNetwork = config.settings().network()
        self._recorded: Recorded | None = None
        self._memory: Tensor | None = None
        self._warned = False
        if manifest is not None:
            self._learn_of(manifest, with_prior=is_new)

    def _learn_of(self, manifest: Manifest, *, with_prior: bool) -> None:
        cameras = tuple(self.network.shape.cameras)
        keys = [key for key in (*recorded_keys(cameras), GOAL_VELOCITY) if key in manifest.features]
        try:
            if missing := sorted({*recorded_keys(cameras)} - {*keys}):
                raise DatasetError(f"it lacks {', '.join(missing)}")
            columns = read_columns(manifest, keys)
        except DatasetError as error:
            logger.warning("no truth to learn from in this dataset: %s", error)
            return
        self._recorded = recorded(columns, cameras, self.config.control_period_s)
        if with_prior:
            q = torch.from_numpy(columns[OBS_STATE][:, :N_JOINTS]).double()
            prior = fit_prior(columns, self.network.views(flange_motion(q)))
            self.network.belief.set_prior(prior)

    def get_optim_params(self) -> Any:
        """All parameters, in one group."""
        return self.parameters()

    def reset(self) -> None:
        """Forget what is believed: a new episode begins."""
        self._memory = None

    def forward(self, batch: dict[str, Tensor]) -> tuple[Tensor, dict[str, float]]:
        """Loss of a batch of windows: the memory goes through each, and is trained with the rest.

        A window begins with a fresh belief, wherever in an episode. Eyes learn from where the
        target is in their images, and what the belief and the head make of it does not reach them;
        where nobody says where it is, they learn from the actions alone.

        Args:
            batch: The inputs (B, T, ...), images uint8, or float in [0, 1], and ``action``
                (B, T, 7); ``observation.state_is_pad`` (B, T), true for frames before the beginning
                of the episode, none if it is missing; ``index`` (B,), the last frame's number in
                the dataset of `dataset_meta`.

        Returns:
            The loss, and its parts as numbers.
        """
        network, weight = self.network, self.config.keypoint_weight
        # Frames before the beginning count for nothing, whatever they hold.
        real = _real(batch)
        state = torch.where(real[:, :, None], batch[OBS_STATE], batch[OBS_STATE][:, -1:])
        truth = self._truth(batch, real)
        goal, felt = (
            None if key is None else batch[key][real].float()
            for key in (self.config.goal_key, self.config.wrench_key)
        )
        images = {name: batch[IMAGE_PREFIX + name][real] for name in network.shape.cameras}
        sightings = network.look(images, goal)
        seen = sightings if truth is None else {n: s.detach() for n, s in sightings.items()}
        views = network.views(flange_motion(state[:, :, :N_JOINTS].double().flatten(0, 1)))
        memory = self._remembered(real, seen, state, views, batch[ACTION], truth)
        out = network.decide(memory, seen, state[real], felt)
        label = network.encode_label(batch[ACTION][real], memory)
        parts = {"action_loss": action_loss(out, label)}
        loss = parts["action_loss"]
        if truth is not None:
            now = truth.at(real)
            parts["tip_loss"] = tip_loss(network, out, label, state[real], now.goal_position)
            loss = loss + TIP_WEIGHT * parts["tip_loss"]
            normal = now.goal_normal.double()
            place = now.goal_position.double() - network.belief.standoff * normal
            parts["belief_loss"], _ = belief_loss(
                memory[:, :BELIEF_SIZE],
                place,
                now.goal_velocity.double(),
                normal[:, :2] / normal[:, 2:],
                network.shape.error_scale,
            )
            for name, sighting in sightings.items():
                rotation = views[name].rotation[real.flatten()]
                facing = (rotation.transpose(1, 2) @ normal[:, :, None])[:, :2, 0].float()
                parts[f"{name}_loss"], _ = sighting_loss(sighting, now.targets[name], facing)
            taught = [part for key, part in parts.items() if key not in ("action_loss", "tip_loss")]
            loss = loss + weight * sum(part.float() for part in taught)
        return loss, {name: part.detach().item() for name, part in parts.items()}

    def _remembered(
        self,
        real: Tensor,
        sightings: dict[str, Tensor],
        state: Tensor,
        views: dict[str, View],
        action: Tensor,
        truth: Recorded | None,
    ) -> Tensor:
        """The memory with each real frame in it, (n, k)."""
        network = self.network
        n, length = real.shape
        windows = {}
        for name, sighting in sightings.items():
            windows[name] = sighting.new_zeros(n, length, SIGHTING_SIZE)
            windows[name][real] = sighting
        poses = {
            name: (view.origin.reshape(n, length, 3), view.rotation.reshape(n, length, 3, 3))
            for name, view in views.items()
        }
        fresh = memory = network.start(n)
        memories = []
        for t in range(length):
            if truth is not None:
                memory = memory.clone()
                memory[:, SET_POINT], memory[:, BEGUN] = truth.set_point[:, t].double(), 1.0
            memory = network.remember(
                memory,
                {name: sighting[:, t] for name, sighting in windows.items()},
                state[:, t, :N_JOINTS],
                {name: View(p[:, t], R[:, t], views[name].tan) for name, (p, R) in poses.items()},
            )
            memories.append(memory)
            # Without a record of what was done, it is taken to be what the demonstrator would do.
            memory = network.commanded(memory, action[:, t]) if truth is None else memory
            memory = torch.where(real[:, t, None], memory, fresh)
        return torch.stack(memories, dim=1)[real]

    def _truth(self, batch: dict[str, Tensor], real: Tensor) -> Recorded | None:
        """What is true of the frames of the windows, as far as the dataset tells."""
        if self.config.keypoint_weight > 0 and self._recorded is not None and INDEX in batch:
            before = torch.arange(1 - real.shape[1], 1, device=real.device)
            rows = (batch[INDEX].reshape(-1, 1) + before).clamp(min=0)
            return self._recorded.at(rows.cpu()).to(real.device)
        if self.training and self.config.keypoint_weight > 0 and not self._warned:
            logger.warning("training on actions alone: nobody says where the target is")
            self._warned = True
        return None

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
            None if key is None else batch[key].float().reshape(len(state), -1)
            for key in (self.config.goal_key, self.config.wrench_key)
        )
        action, self._memory = act(
            self.network,
            {name: batch[IMAGE_PREFIX + name] for name in self.network.shape.cameras},
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


def _manifest(dataset_meta: Any) -> Manifest | None:
    """What a dataset says of itself, if there is one that this suite recorded."""
    if dataset_meta is None:
        return None
    try:
        return read_manifest(Path(dataset_meta.root))
    except DatasetError as error:
        logger.warning("nothing is known of the task of this dataset: %s", error)
        return None


def _take_over(config: HvsBeliefConfig, manifest: Manifest) -> None:
    """Take what a policy is trained for, and its cell, from a dataset."""
    spec = find(manifest.task).with_options(manifest.options)
    for name, value in trained_for(spec).model_dump().items():
        setattr(config, name, value)
    config.cell = as_numbers(cell_model(spec))


def _real(batch: dict[str, Tensor]) -> Tensor:
    """Which frames of the windows are frames of the episode, (B, T)."""
    if PADDED in batch:
        return ~batch[PADDED]
    state = batch[OBS_STATE]
    return torch.ones(state.shape[:2], dtype=torch.bool, device=state.device)


def save_checkpoint(policy: HvsBeliefPolicy, folder: Path) -> None:
    """Write a checkpoint that LeRobot and the suite load, each file whole or not at all.

    Args:
        policy: The policy.
        folder: Gets ``config.json``, ``model.safetensors`` and the two processors.

    Raises:
        OutputError: It cannot be written; what stood there before still does.
    """
    from hvs_suite.policies.hvs_belief.processor_hvs_belief import (
        make_hvs_belief_pre_post_processors,
    )

    write_checkpoint(policy, make_hvs_belief_pre_post_processors(policy.config), folder)
