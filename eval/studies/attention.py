"""Pictures of where an `hvs` policy looks: its attention over both cameras, through an episode."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import torch

from hvs_suite.pictures import GREEN, Picture, as_rgb, resize, strip
from hvs_suite.policies.belief.eye import UV, VISIBLE
from hvs_suite.policies.checkpoints.files import read_config
from hvs_suite.policies.checkpoints.loading import load_network, network_inputs
from hvs_suite.rollout import (
    Action,
    Instructed,
    Observation,
    Policy,
    one_torch_thread,
    run_episode,
)

if TYPE_CHECKING:
    from PIL.Image import Image

    from hvs_suite.tasks.shared.environment import Environment

COLUMNS = 6
_TILE_PX = 200
# Neither the arm's colours nor the disc's.
_HEAT = np.array([255.0, 225.0, 0.0])
_ESTIMATE = (20, 60, 200)
_STRENGTH = 0.75
TITLES = {"eih": "eye in hand", "eth": "eye to hand"}


def draw_attention(folder: Path, env: "Environment", policy: Policy, scenario: int) -> "Image":
    """Play a scenario and draw what the eyes made of it, evenly spaced in time.

    Yellow is the attention, the distribution whose mean is the keypoint; the cross is where the eye
    takes the target to be, drawn if it believes that it sees it; the circle is where it is.

    Args:
        folder: Checkpoint of an `hvs` policy.
        env: The task; left at the last step of the episode.
        policy: Plays; the same checkpoint, say.
        scenario: Index in the environment's split.

    Returns:
        One row a camera.

    Raises:
        PolicyError: The checkpoint is not of an `hvs` policy, or cannot be loaded.
    """
    network, config = load_network(folder), read_config(folder)
    seen = _Seen(env, policy)
    run_episode(env, seen, scenario)
    steps = np.unique(np.linspace(0, len(seen.observations) - 1, COLUMNS).round().astype(int))
    shown = {step: network_inputs(network, config, seen.observations[step]) for step in steps}
    rows = {
        TITLES[camera]: [
            _tile(
                network.eyes[camera],
                inputs.images[camera],
                inputs.goal,
                seen.observations[step][camera],
                seen.truths[step][camera],
            )
            for step, inputs in shown.items()
        ]
        for camera in network.shape.cameras
    }
    return strip(rows, [step * env.spec.control_period_s for step in steps])


class _Seen:
    """A policy that keeps what it was shown, and where the target was in it."""

    def __init__(self, env: "Environment", policy: Policy) -> None:
        self._env = env
        self._policy = policy
        self.observations: list[Observation] = []
        self.truths: list[dict[str, npt.NDArray[Any]]] = []

    def instruct(self, sentence: str) -> None:
        if isinstance(self._policy, Instructed):
            self._policy.instruct(sentence)

    def reset(self) -> None:
        self._policy.reset()

    def select_action(self, observation: Observation) -> Action:
        truth = self._env.privileged()
        self.observations.append({name: np.array(value) for name, value in observation.items()})
        self.truths.append({camera: truth[f"target_{camera}"] for camera in TITLES})
        return self._policy.select_action(observation)


def _tile(
    eye: Any,
    seen: torch.Tensor,
    goal: torch.Tensor | None,
    image: npt.NDArray[Any],
    truth: npt.NDArray[Any],
) -> Picture:
    """One picture under its attention, with estimate and truth marked."""
    from PIL import Image, ImageDraw

    with torch.no_grad(), one_torch_thread():
        heat = eye.attention(seen, goal)[0].numpy()
        sighting = eye(seen, goal)[0]
    picture = resize(as_rgb(image), _TILE_PX).astype(np.float64)
    spread = Image.fromarray((heat / heat.max()).astype(np.float32), mode="F")
    share = np.asarray(spread.resize((_TILE_PX, _TILE_PX), Image.Resampling.BILINEAR))[..., None]
    share = _STRENGTH * share.clip(0.0, 1.0)
    tile = Image.fromarray(((1.0 - share) * picture + share * _HEAT).round().astype(np.uint8))
    draw = ImageDraw.Draw(tile)
    if truth[3] > 0.5:
        x, y = _pixel(truth[:2])
        draw.ellipse((x - 9, y - 9, x + 9, y + 9), outline=GREEN, width=2)
    if float(sighting[VISIBLE]) > 0.0:
        x, y = _pixel(sighting[UV].numpy())
        draw.line((x - 7, y, x + 7, y), _ESTIMATE, 2)
        draw.line((x, y - 7, x, y + 7), _ESTIMATE, 2)
    return np.asarray(tile)


def _pixel(uv: npt.NDArray[Any]) -> tuple[float, float]:
    """Place in a tile of image coordinates in [-1, 1]."""
    return float(uv[0] + 1.0) / 2.0 * _TILE_PX, float(uv[1] + 1.0) / 2.0 * _TILE_PX
