"""A picture of an RL run: success and haste amid training, and what learned them."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

from hvs_suite.files import replacing
from hvs_suite.policies.rl.evaluation import Evaluation
from hvs_suite.policies.training.plot import PICTURE, read_curves

PERCENT = 100.0


@dataclasses.dataclass(frozen=True)
class _Group:
    """Curves that share axes; drawn if the run has any of them."""

    title: str
    unit: str
    labels: Mapping[str, str]
    scale: float = 1.0


GROUPS = (
    _Group(
        "while exploring",
        "share of the last 100 episodes (%)",
        {
            "rollout/success_rate": "solved",
            "rollout/success": "solved",
            "rollout/collision": "collided",
        },
        PERCENT,
    ),
    _Group(
        "candidates of a generation",
        "control steps outside, and penalty",
        {"rollout/outside": "mean", "rollout/outside of the best": "best"},
    ),
    _Group(
        "learning",
        "",
        {
            "train/critic_loss": "critics' loss",
            "train/value": "mean value",
            "train/residual": "residual, share of its bound",
            "train/ent_coef": "temperature",
        },
    ),
    _Group(
        "spread of the candidates",
        "share of the largest shift",
        {"train/spread": "standard deviation"},
    ),
)


def draw_rl_run(training: Path, evaluations: Sequence[Evaluation]) -> Path:
    """Draw a run from its evaluations and curves.

    Args:
        training: Folder of its state, which holds TensorBoard's files.
        evaluations: In order, one at least.

    Returns:
        The picture, ``training.png`` in that folder.

    Raises:
        OutputError: It cannot be written.
    """
    from matplotlib.figure import Figure

    curves = read_curves(training / "tensorboard")
    drawn = [group for group in GROUPS if any(name in curves for name in group.labels)]
    figure = Figure(figsize=(3.25 * (2 + len(drawn)), 3.4), layout="constrained")
    success, haste, *further = figure.subplots(1, 2 + len(drawn))
    steps = [each.env_steps / 1000.0 for each in evaluations]
    rates = [100.0 * each.success_rate for each in evaluations]
    ranges = [each.interval for each in evaluations]
    success.plot(steps, rates, color="tab:green", marker="o", markersize=3, linewidth=1.2)
    success.fill_between(
        steps, [low for low, _ in ranges], [high for _, high in ranges], color="tab:green",
        alpha=0.15, linewidth=0,
    )  # fmt: skip
    success.set(ylim=(0.0, 102.0), ylabel="solved (%), with Wilson's 95 % interval")
    success.set_title(f"evaluations, {evaluations[-1].episodes} episodes each")
    outside = [each.outside for each in evaluations]
    haste.plot(steps, outside, color="tab:green", marker="o", markersize=3, linewidth=1.2)
    haste.set(ylabel="control steps, mean")
    haste.set_title("outside the tolerances in an episode")
    for axes, group in zip(further, drawn, strict=True):
        for name, label in group.labels.items():
            if name in curves:
                played, values = curves[name]
                axes.plot(played / 1000.0, group.scale * values, label=label, linewidth=1.2)
        axes.set(ylabel=group.unit, title=group.title)
        if group.scale == PERCENT:
            axes.set(ylim=(0.0, 102.0))
        if len(group.labels) > 1:
            axes.legend(frameon=False, fontsize=8)
    for axes in (success, haste, *further):
        axes.set_xlabel("environment steps (thousands)")
        axes.grid(alpha=0.3)
    target = training / PICTURE
    with replacing(target) as temporary:
        figure.savefig(temporary, format="png", dpi=110)
    return target
