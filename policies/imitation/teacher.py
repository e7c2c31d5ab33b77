"""How the `hvs` network learns from demonstrations: its eyes from frames, the rest from windows.

The training falls into parts, one more than there are DAgger rounds. In each of them the eyes learn
first, from frames, for `Settings.eye_share` of it; then they look at all frames, and belief and
head learn from windows of what they saw. So the belief learns of the errors that these very eyes
make, and what plays the next round has eyes and a belief that know each other.
"""

import bisect
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor, nn

from hvs_suite.datasets.features import STATE
from hvs_suite.errors import DatasetError
from hvs_suite.policies.belief.lessons import eye_lesson, window_lesson
from hvs_suite.policies.belief.network import N_JOINTS
from hvs_suite.policies.belief.prior import take_prior
from hvs_suite.policies.belief.recorded import recorded, recorded_keys
from hvs_suite.policies.imitation.dagger import round_shares
from hvs_suite.policies.imitation.demonstrations import Demonstrations
from hvs_suite.policies.imitation.settings import Settings
from hvs_suite.policies.imitation.slopes import Meter
from hvs_suite.policies.imitation.windows import Rows, WindowPool
from hvs_suite.policies.training.dataset import EPISODE

if TYPE_CHECKING:
    from hvs_suite.policies.hvs.modeling_hvs import HvsPolicy

RECALL_SHARE = 0.05
"""How often the belief goes through all episodes again."""
# Philox words that keep this stream apart from others of the same seed.
WINDOW_STREAM = 6
SEEN = "seen.safetensors"
HELD_OUT_BATCH = 128
HELD_OUT_FRAMES = 512

Parts = dict[str, float]


class Teacher:
    """Teaches `HvsPolicy`.

    Args:
        policy: What learns.
        demonstrations: What it learns from.
        settings: Of the run.
        folder: Keeps what the eyes saw.
    """

    def __init__(
        self,
        policy: "HvsPolicy",
        demonstrations: Demonstrations,
        settings: Settings,
        folder: Path,
    ) -> None:
        self.policy = policy
        self.demonstrations = demonstrations
        self._settings = settings
        self._file = folder / SEEN
        config = policy.config
        self._windows = WindowPool(demonstrations, config.goal_key, config.wrench_key)
        self._bounds = [0.0, *round_shares(settings.dagger_rounds), 1.0]
        self._looked_in = -1
        """Part of the training in which the eyes looked at all frames last."""
        self._due = 0.0
        self._opened = False
        self._share, self._at, self._eyes_learn = 0.0, 0, True

    def clipped_apart(self) -> list[list[nn.Parameter]]:
        """The eyes, and the rest: they learn in turns."""
        eyes = list(self.policy.network.eyes.parameters())
        known = {id(parameter) for parameter in eyes}
        return [eyes, [p for p in self.policy.parameters() if id(p) not in known]]

    def advance(self, share: float) -> None:
        """Say how far the training is; at first, take up what a killed run saw last.

        Args:
            share: Of the training that is done, 0 to 1.
        """
        if not self._opened:
            self._reopen(share)
        self._share = share
        self._at, self._eyes_learn = self._part(share)

    @property
    def is_due(self) -> bool:
        """Whether eyes or belief are to go through everything again."""
        if self._eyes_learn:
            return False
        return self._at > self._looked_in or self._share >= self._due

    def _part(self, share: float) -> tuple[int, bool]:
        """Which part of the training this is, and whether it is the eyes' turn."""
        part = min(bisect.bisect_right(self._bounds, share) - 1, len(self._bounds) - 2)
        begin, end = self._bounds[part : part + 2]
        return part, share < begin + self._settings.eye_share * (end - begin)

    def _reopen(self, share: float) -> None:
        """Go on with what a killed run saw last, if it has gone so far."""
        self._opened = True
        kept = self._windows.reopen(self._file, self.policy.network) if share > 0.0 else None
        if kept is not None:
            self._looked_in, self._due = self._part(kept)[0], _next_due(kept)

    def look_again(self, meter: Meter | None = None) -> None:
        """Look at all frames once in each part of the training; recall all episodes.

        This takes too long for every step; the result is a function of the weights. It may change
        them, see `WindowPool.look`, so `keep` it once they are written.

        Args:
            meter: Reports how far it is.
        """
        network = self.policy.network
        self.policy.eval()
        if self._at > self._looked_in:
            self._windows.look(network, meter)
        else:
            self._windows.recall(network)
        self.policy.train()
        self._looked_in, self._due = self._at, _next_due(self._share)

    def keep(self) -> None:
        """Write what was seen, for a killed run to go on with."""
        self._windows.keep(self._file, self._share)

    def lesson(self, rows: Rows, step: int) -> tuple[Tensor, Parts]:
        """Loss to learn from, and what it is made of.

        Args:
            rows: Frames to learn from.
            step: Number of the optimiser step, which all draws are a function of.
        """
        network, settings = self.policy.network, self._settings
        if self._eyes_learn and "keypoints" not in settings.without:
            loss, parts = self._eye_lesson(rows)
        else:
            key = np.random.Philox(key=[settings.seed, WINDOW_STREAM], counter=step)
            random, length = np.random.Generator(key), settings.window_steps
            weights = self.demonstrations.weights()
            anew = self._eyes_learn
            n = max(1, settings.batch_size // length) if anew else settings.windows
            window = self._windows.draw(network, weights, n, length, random, anew=anew)
            loss, parts = window_lesson(network, window)
        return loss, {name: part.item() for name, part in parts.items()}

    def _eye_lesson(self, rows: Rows) -> tuple[Tensor, dict[str, Tensor]]:
        network = self.policy.network
        batch = self.demonstrations.batch(rows)
        columns = {key: value.numpy() for key, value in batch.items() if "images" not in key}
        # Frames of a batch are no episodes: where the arm was sent is not asked here.
        columns[EPISODE] = np.arange(len(rows))
        truth = recorded(columns, tuple(network.shape.cameras), network.cell.period_s)
        seen = network.see(*self._windows.pictures(network, batch))
        return eye_lesson(network, seen, batch[STATE][:, :N_JOINTS], truth)

    def held_out(self) -> Parts:
        """Mean losses of the eyes on frames spread over the held-out episodes; empty without any.

        Of the eyes alone, because these frames are seen for the first time.
        """
        indices = self.demonstrations.held_out
        if not len(indices):
            return {}
        spread = np.linspace(0, len(indices) - 1, min(len(indices), HELD_OUT_FRAMES))
        indices = indices[spread.astype(np.int64)]
        sums: Parts = {}
        self.policy.eval()
        with torch.no_grad():
            for first in range(0, len(indices), HELD_OUT_BATCH):
                some = indices[first : first + HELD_OUT_BATCH]
                loss, parts = self._eye_lesson(some)
                for name, value in {"loss": loss, **parts}.items():
                    sums[name] = sums.get(name, 0.0) + value.item() * len(some)
        self.policy.train()
        return {name: value / len(indices) for name, value in sums.items()}

    def save(self, out: Path) -> None:
        """Write the checkpoint."""
        from hvs_suite.policies.hvs.modeling_hvs import save_checkpoint

        save_checkpoint(self.policy, out)


def set_prior(policy: "HvsPolicy", demonstrations: Demonstrations) -> None:
    """Give a fresh policy the prior of what it is to learn from.

    Args:
        policy: Gets it.
        demonstrations: What it is to learn from.

    Raises:
        DatasetError: Columns are missing that say what is true.
    """
    network = policy.network
    columns = demonstrations.columns()
    if missing := sorted({*recorded_keys(tuple(network.shape.cameras))} - {*columns}):
        raise DatasetError(
            f"{demonstrations.manifest.root} lacks {', '.join(missing)}, from which hvs "
            "learns; record it with hvs record"
        )
    take_prior(network, columns)


def _next_due(share: float) -> float:
    return RECALL_SHARE * (int(share / RECALL_SHARE + 1e-9) + 1)
