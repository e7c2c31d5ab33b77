"""A picture of an RL run: success and haste amid training, and what learned them."""

from collections.abc import Sequence
from pathlib import Path

from hvs_suite.files import replacing
from hvs_suite.policies.rl.evaluation import Evaluation
from hvs_suite.policies.training.plot import PICTURE, read_curves

ROLLOUT = {"rollout/success_rate": "solved", "rollout/collision": "collided"}
LOSSES = {
    "train/critic_loss": "critics' loss",
    "train/value": "mean value",
    "train/residual": "residual, share of its bound",
    "train/ent_coef": "temperature",
}


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
    figure = Figure(figsize=(13.0, 3.4), layout="constrained")
    success, haste, playing, learning = figure.subplots(1, 4)
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
    for name, label in ROLLOUT.items():
        if name in curves:
            playing.plot(
                curves[name][0] / 1000.0, 100.0 * curves[name][1], label=label, linewidth=1.2
            )
    playing.set(ylim=(0.0, 102.0), ylabel="share of the last 100 episodes (%)")
    playing.set_title("while exploring")
    for name, label in LOSSES.items():
        if name in curves:
            learning.plot(curves[name][0] / 1000.0, curves[name][1], label=label, linewidth=1.2)
    learning.set_title("learning")
    for axes in (success, haste, playing, learning):
        axes.set_xlabel("environment steps (thousands)")
        axes.grid(alpha=0.3)
    for axes in (playing, learning):
        if axes.lines:
            axes.legend(frameon=False, fontsize=8)
    target = training / PICTURE
    with replacing(target) as temporary:
        figure.savefig(temporary, format="png", dpi=110)
    return target
