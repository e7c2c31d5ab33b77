"""Train LeRobot's ACT on frames that a GPU holds, in one of several settings: see act.md.

    python docs/experiments/act_settings.py novae-b64 --data runs/data/align-easy \
        --out runs/act/novae-b64 --seconds 435

What comes out is a LeRobot checkpoint, for ``hvs evaluate --policy``.
"""

import argparse
import json
import math
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812 - torch's own name for it
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.policies.act.processor_act import make_act_pre_post_processors
from torch import Tensor

from hvs_suite.policies.imitation.frame_cache import cached_frames
from hvs_suite.policies.training.dataset import read_columns, read_manifest

CAMERAS = ("eih", "eth")
SIDE = 112
CHUNK = 10
WARM_UP_STEPS = 300
FASTER: dict[str, Any] = {"vae": False, "rate": 3e-4, "cosine": True}
SETTINGS: dict[str, dict[str, Any]] = {
    "docs": {"vae": True, "rate": 1e-4, "cosine": False, "batch": 16},
    "novae": {**FASTER, "batch": 16},
    "novae-b64": {**FASTER, "batch": 64},
}
"""``docs`` is the command of docs/baselines.md, but for the batch."""


class Data:
    """A dataset's frames and columns on a device, and batches as ACT takes them.

    Args:
        root: The dataset.
        cache: Folder for the decoded frames.
        device: Where all of it goes.
    """

    def __init__(self, root: Path, cache: Path, device: str) -> None:
        manifest = read_manifest(root)
        columns = read_columns(manifest)
        self.n = manifest.n_frames
        self.device = device
        self.frames = {
            name: torch.from_numpy(
                np.array(
                    cached_frames(
                        root, f"observation.images.{name}", (SIDE, SIDE, 3), self.n, cache
                    )
                )
            ).to(device)
            for name in CAMERAS
        }
        self.state = torch.tensor(columns["observation.state"], device=device)
        self.action = torch.tensor(columns["action"], device=device)
        ends = np.r_[np.flatnonzero(np.diff(columns["episode_index"])), self.n - 1]
        last = ends[np.searchsorted(ends, np.arange(self.n))]
        self.last = torch.from_numpy(last).to(device)
        self.stats = json.loads((root / "meta" / "stats.json").read_text(encoding="utf-8"))

    def _scaled(self, values: Tensor, key: str) -> Tensor:
        mean, std = (torch.tensor(self.stats[key][name]).flatten() for name in ("mean", "std"))
        shape = (-1, 1, 1) if values.ndim == 4 else (-1,)
        mean, std = (each.reshape(shape).float().to(self.device) for each in (mean, std))
        return (values - mean) / (std + 1e-8)

    def batch(self, rows: Tensor) -> dict[str, Any]:
        """Images, joints and the next actions of some frames, scaled by the dataset's statistics.

        Args:
            rows: (m,) of the dataset.
        """
        images = []
        for name, frames in self.frames.items():
            picture = frames[rows].permute(0, 3, 1, 2).float() / 255.0
            images.append(self._scaled(picture, f"observation.images.{name}"))
        steps = rows[:, None] + torch.arange(CHUNK, device=self.device)
        last = self.last[rows][:, None]
        return {
            "observation.images": images,
            "observation.state": self._scaled(self.state[rows], "observation.state"),
            "action": self._scaled(self.action[torch.minimum(steps, last)], "action"),
            "action_is_pad": steps > last,
        }


def main() -> None:
    """Train, and write the checkpoint."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("setting", choices=sorted(SETTINGS))
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seconds", type=float, required=True)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    options = parser.parse_args()
    setting = SETTINGS[options.setting]
    torch.manual_seed(0)
    torch.backends.cuda.matmul.allow_tf32 = True
    data = Data(options.data, options.out / "cache", options.device)
    features = {
        f"observation.images.{name}": PolicyFeature(FeatureType.VISUAL, (3, SIDE, SIDE))
        for name in CAMERAS
    } | {"observation.state": PolicyFeature(FeatureType.STATE, (14,))}
    config = ACTConfig(
        input_features=features,
        output_features={"action": PolicyFeature(FeatureType.ACTION, (7,))},
        device="cpu",
        push_to_hub=False,
        chunk_size=CHUNK,
        n_action_steps=1,
        pretrained_backbone_weights=None,
        dim_model=128,
        n_heads=4,
        dim_feedforward=512,
        n_encoder_layers=2,
        n_vae_encoder_layers=2,
        latent_dim=16,
        use_vae=setting["vae"],
    )
    policy = ACTPolicy(config).to(options.device).train()
    learner = torch.optim.AdamW(policy.parameters(), lr=setting["rate"], weight_decay=1e-4)
    begin, steps, losses = time.monotonic(), 0, []
    while (share := (time.monotonic() - begin) / options.seconds) < 1.0:
        fall = 0.5 * (1.0 + math.cos(math.pi * share)) if setting["cosine"] else 1.0
        learner.param_groups[0]["lr"] = setting["rate"] * fall * min(1.0, steps / WARM_UP_STEPS)
        batch = data.batch(torch.randint(data.n, (setting["batch"],), device=options.device))
        actions, (mean, log_variance) = policy.model(batch)
        there = ~batch["action_is_pad"].unsqueeze(-1)
        error = F.l1_loss(batch["action"], actions, reduction="none")
        loss = off = (error * there).sum() / (there.sum() * error.shape[-1])
        if setting["vae"]:
            divergence = 1.0 + log_variance - mean.pow(2) - log_variance.exp()
            loss = off - 0.5 * config.kl_weight * divergence.sum(-1).mean()
        learner.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(policy.parameters(), 10.0)
        learner.step()
        steps += 1
        if steps % 50 == 0:
            losses.append(float(off.detach()))
    policy.cpu().eval().save_pretrained(options.out)
    stats = {
        key: {name: torch.tensor(value).float() for name, value in some.items()}
        for key, some in data.stats.items()
        if key in features or key == "action"
    }
    for processor in make_act_pre_post_processors(config, stats):
        processor.save_pretrained(options.out)
    print(f"{steps} steps, {steps * setting['batch']} frames, L1 {np.mean(losses[-20:]):.4f}")


if __name__ == "__main__":
    main()
