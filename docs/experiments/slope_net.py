"""What a small convolutional network says of a slope: see looks-at-a-slope.md.

Arguments: a dataset of a surface task, and a folder of weights whose eyes find the target. Learns
from the frames of the eye in the hand, every sixth episode held out. What the network sees is the
target as a camera sees it that looks straight at it, at the same size always; each time it is
turned by any angle and half of the times mirrored.
"""

import argparse
import io
import itertools
import math
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import torch
from PIL import Image
from torch import Tensor, nn
from torch.nn.functional import grid_sample

from hvs_suite.policies.belief import geometry
from hvs_suite.policies.belief.colour_slope import AROUND, CORE, turn_to
from hvs_suite.policies.checkpoints.loading import load_network
from hvs_suite.policies.training.dataset import read_columns, read_manifest

SIDE = 48
"""Side of the turned picture (px)."""
REACH = 1.5
"""How far it reaches from the target's centre (diameters)."""
WIDTH = 24
BATCH = 64
LEARNING_RATE = 2e-3
TURNS = 4
"""What is said is the mean over so many turns of the picture."""
LEANS_DEG = (0, 2, 5, 10, 20, 30, 45)
NEAR = 0.1
"""Targets that are smaller are not counted (image widths)."""
SURE_DEG = 0.3


def frames_of(data: Path, weights: Path) -> dict[str, Any]:
    """Frames that show the target, and where the eyes of the weights take it to be."""
    network = load_network(weights).eval()
    columns = read_columns(read_manifest(data))
    joints = torch.tensor(columns["observation.state"][:, :7]).double()
    normal = torch.tensor(columns["privileged.goal_normal"]).double()[..., None]
    rotation = network.views(geometry.flange_motion(joints))["eih"].rotation
    true = torch.tensor(columns["privileged.target_eih"]).float()
    is_seen = (true[:, 3] > 0.5) & (true[:, 2] > 0.08) & (true[:, :2].abs().amax(1) < 0.95)
    rows = torch.where(is_seen)[0]
    files = [
        picture.as_py()["bytes"]
        for part in sorted(data.glob("data/**/*.parquet"))
        for picture in pq.read_table(part, columns=["observation.images.eih"]).column(0)
    ]
    pixels = [np.asarray(Image.open(io.BytesIO(files[row])).convert("RGB")) for row in rows]
    pictures = torch.tensor(np.stack(pixels)).permute(0, 3, 1, 2)
    with torch.no_grad():
        said = torch.cat([network.eyes["eih"](part) for part in torch.split(pictures, 256)])
    keep = said[:, 3] > 0.0
    rows, said = rows[keep], said[keep]
    return {
        "pictures": pictures[keep],
        "uv": said[:, :2].clamp(-1.2, 1.2),
        "log_diameter": said[:, 2:3],
        "normal": (rotation.transpose(1, 2) @ normal)[rows, :, 0].float(),
        "rotation": rotation[rows],
        "size": true[rows, 2],
        "episode": torch.tensor(np.asarray(columns["episode_index"]))[rows],
        "tan": network.cell.tan["eih"],
    }


def turned(frames: dict[str, Any], rows: Tensor, angle: Tensor, mirror: Tensor) -> Tensor:
    """How much of the target's colour each pixel has, how much of others, and what is in view.

    Args:
        frames: As of `frames_of`.
        rows: Which of them, (B,).
        angle: By how much each is turned, (B, 1) rad.
        mirror: 1, or -1 for mirrored, (B, 1).

    Returns:
        (B, 3, SIDE, SIDE).
    """
    pictures = frames["pictures"][rows].float() / 255.0
    side = pictures.shape[-1]
    uv, tan = frames["uv"][rows], frames["tan"]
    diameter = frames["log_diameter"][rows].exp().clamp(0.01, 1.0)
    ticks = (2.0 * torch.arange(side) + 1.0) / side - 1.0
    v, u = torch.meshgrid(ticks, ticks, indexing="ij")
    off = torch.stack([u, v])[None] - uv[..., None, None]
    radius = off.square().sum(1, keepdim=True).sqrt() / (2.0 * diameter[..., None, None])
    core = (radius < CORE).float()
    own = (pictures * core).sum((2, 3)) / core.sum((2, 3)).clamp(min=1.0)
    around = pictures.masked_fill(radius > AROUND, math.nan)[:, :, ::2, ::2].flatten(2)
    other = around.nanmedian(2).values.nan_to_num(0.0)[..., None, None]
    way = own[..., None, None] - other
    length = way.square().sum(1, keepdim=True).clamp(min=1e-4)
    along = ((pictures - other) * way).sum(1, keepdim=True) / length
    beside = (pictures - other - along * way).square().sum(1, keepdim=True) / length
    told = torch.cat([along.clamp(-1.0, 2.0), beside.sqrt().clamp(0.0, 2.0)], 1)
    ticks = REACH * ((2.0 * torch.arange(SIDE) + 1.0) / SIDE - 1.0)
    y, x = (each.flatten()[None] for each in torch.meshgrid(ticks, ticks, indexing="ij"))
    cos, sin = angle.cos(), angle.sin()
    at = torch.stack([x * cos - mirror * y * sin, x * sin + mirror * y * cos], 1)
    rays = torch.cat([2.0 * tan * diameter[..., None] * at, torch.ones_like(at[:, :1])], 1)
    rays = turn_to(uv, tan).transpose(1, 2) @ rays
    places = (rays[:, :2] / rays[:, 2:].clamp(min=0.1) / tan).transpose(1, 2)
    places = places.reshape(-1, SIDE, SIDE, 2)
    in_view = (places.abs() < 1.0).all(-1)[:, None].float()
    return torch.cat([grid_sample(told, places, align_corners=False) * in_view, in_view], 1)


def slope_in(frames: dict[str, Any], rows: Tensor, angle: Tensor, mirror: Tensor) -> Tensor:
    """The true slope as the turned picture shows it, (B, 2)."""
    normal = turn_to(frames["uv"][rows], frames["tan"]) @ frames["normal"][rows][..., None]
    x, y = normal[:, 0], normal[:, 1]
    cos, sin = angle.cos(), angle.sin()
    return torch.cat([cos * x + sin * y, mirror * (cos * y - sin * x)], 1)


class Net(nn.Module):
    """From a turned picture and the size of the target to a slope and its doubt."""

    def __init__(self) -> None:
        super().__init__()

        def block(n_in: int, n_out: int, stride: int) -> nn.Module:
            conv = nn.Conv2d(n_in, n_out, 3, stride, 1)
            return nn.Sequential(conv, nn.GroupNorm(4, n_out), nn.GELU())

        w = WIDTH
        widths = ((3, w, 1), (w, w, 2), (w, 2 * w, 1), (2 * w, 2 * w, 2), (2 * w, 3 * w, 1))
        self.features = nn.Sequential(*(block(*each) for each in widths), block(3 * w, 3 * w, 2))
        n = 3 * w * (SIDE // 8) ** 2
        self.head = nn.Sequential(nn.Linear(n + 1, 128), nn.GELU(), nn.Linear(128, 3))

    def forward(self, pictures: Tensor, log_diameter: Tensor) -> Tensor:
        """Slope (two) and the logarithm of its standard deviation, (B, 3)."""
        told = self.features(pictures).flatten(1)
        said: Tensor = self.head(torch.cat([told, log_diameter], 1))
        return torch.cat([0.2 * said[:, :2], said[:, 2:] - 3.0], 1)


def learn(net: Net, frames: dict[str, Any], training: Tensor, passes: int) -> None:
    """Adam on the likelihood of the true slope, after a first pass on its square."""
    optimiser = torch.optim.AdamW(net.parameters(), LEARNING_RATE, weight_decay=1e-3)
    n_steps = passes * (len(training) // BATCH)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, LEARNING_RATE, total_steps=n_steps)
    for step in range(n_steps):
        rows = training[torch.randint(len(training), (BATCH,))]
        angle = 2.0 * math.pi * torch.rand(BATCH, 1)
        mirror = torch.where(torch.rand(BATCH, 1) < 0.5, -1.0, 1.0)
        said = net(turned(frames, rows, angle, mirror), frames["log_diameter"][rows])
        square = (said[:, :2] - slope_in(frames, rows, angle, mirror)).square().sum(1)
        log_variance = 2.0 * said[:, 2]
        likelihood = square / (2.0 * log_variance.exp()) + log_variance
        loss = (likelihood if step * passes >= n_steps else 50.0 * square).mean()
        optimiser.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(net.parameters(), 1.0)
        optimiser.step()
        schedule.step()
        if step % 500 == 0:
            print(f"step {step} of {n_steps}, loss {loss.item():.2f}", flush=True)


@torch.no_grad()
def say(net: Net, frames: dict[str, Any], rows: Tensor) -> tuple[Tensor, Tensor]:
    """Normals in the optical frame (n, 3), and standard deviations (n,)."""
    normals, doubts = [], []
    for part in torch.split(rows, 256):
        told = torch.zeros(len(part), 2)
        doubt = torch.zeros(len(part))
        for turn in range(TURNS):
            angle = torch.full((len(part), 1), 2.0 * math.pi * turn / TURNS)
            pictures = turned(frames, part, angle, torch.ones_like(angle))
            x, y, doubtful = net(pictures, frames["log_diameter"][part]).T
            cos, sin = angle[:, 0].cos(), angle[:, 0].sin()
            told += torch.stack([cos * x - sin * y, sin * x + cos * y], 1) / TURNS
            doubt += doubtful / TURNS
        told = told / (told.norm(dim=1, keepdim=True) / 0.98).clamp(min=1.0)
        straight = torch.cat([told, -(1.0 - told.square().sum(1, keepdim=True)).sqrt()], 1)
        back = turn_to(frames["uv"][part], frames["tan"]).transpose(1, 2)
        normals.append((back @ straight[..., None])[..., 0])
        doubts.append(doubt.exp())
    return torch.cat(normals), torch.cat(doubts)


def report(frames: dict[str, Any], rows: Tensor, normals: Tensor, doubts: Tensor) -> None:
    """Print errors of single looks by lean, and of all looks of a scene together (degrees)."""
    rows, normals, doubts = (each[frames["size"][rows] > NEAR] for each in (rows, normals, doubts))
    true = frames["normal"][rows]
    lean = torch.rad2deg(true[:, :2].norm(dim=1).clamp(max=1.0).asin())
    error = torch.rad2deg((normals - true)[:, :2].norm(dim=1))
    for low, high in itertools.pairwise(LEANS_DEG):
        part = (lean >= low) & (lean < high)
        print(f"lean {low} to {high}: {int(part.sum())} frames, {error[part].median():.2f}")
    based, aim = (
        (frames["rotation"][rows] @ each.double()[..., None])[..., 0] for each in (normals, true)
    )
    weight = doubts.double()[:, None] ** -2
    together = []
    for episode in frames["episode"][rows].unique():
        part = frames["episode"][rows] == episode
        if part.sum() >= 8:
            mean = (weight[part] * based[part]).sum(0)
            cosine = (mean @ aim[part][0] / mean.norm()).clamp(max=1.0)
            together.append(math.degrees(cosine.acos()))
    print(
        f"{len(together)} scenes: {np.median(together):.2f} in the median, "
        f"{np.mean(np.array(together) < SURE_DEG):.0%} within {SURE_DEG}"
    )


def main() -> None:
    """Learn, and say how well it tells slopes of episodes that it has not learned from."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument("weights", type=Path)
    parser.add_argument("--passes", type=int, default=25)
    options = parser.parse_args()
    torch.manual_seed(0)
    torch.set_num_threads(1)
    frames = frames_of(options.data, options.weights)
    is_held_out = frames["episode"] % 6 == 5
    net = Net()
    learn(net, frames, torch.where(~is_held_out)[0], options.passes)
    held_out = torch.where(is_held_out)[0]
    report(frames, held_out, *say(net.eval(), frames, held_out))


if __name__ == "__main__":
    main()
