"""A picture of a training run: its losses, and how its DAgger rounds went."""

import json
import logging
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hvs_suite.files import replacing

if TYPE_CHECKING:
    from matplotlib.axes import Axes

PICTURE = "training.png"
# Means over so many logged points (of 20 steps each), so that a line shows and not a cloud.
SMOOTHED_POINTS = 10
EYES = {"eih_loss": "eye in hand", "eth_loss": "eye to hand"}
REST = {
    "action_loss": "action",
    "tip_loss": "where the tip goes",
    "belief_place_loss": "place of the target",
}
Curve = tuple[Any, Any]


def draw_run(out: Path) -> Path:
    """Draw a run that `pretrain` left.

    Args:
        out: The run's folder; TensorBoard's files and the rounds lie in ``out/training``.

    Returns:
        The picture, ``out/training/training.png``.

    Raises:
        OutputError: It cannot be written.
    """
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    curves = read_curves(out / "training" / "tensorboard")
    rounds = _rounds(out / "training" / "dagger")
    figure = Figure(figsize=(11.0, 3.6), layout="constrained")
    eyes, rest, played = figure.subplots(1, 3)
    _draw(eyes, curves, {f"train/{key}": name for key, name in EYES.items()})
    eyes.set_prop_cycle(None)
    held_out = {f"held_out/{key}": f"{name}, held out" for key, name in EYES.items()}
    _draw(eyes, curves, held_out, linestyle="--")
    _draw(rest, curves, {f"train/{key}": name for key, name in REST.items()})
    eyes.set_title("loss of the eyes")
    rest.set_title("losses of belief and head, in their turns")
    # Likelihoods fall below zero; what lies near it is drawn to scale.
    eyes.set_yscale("symlog")
    # Between two powers of ten there would be no figure.
    eyes.yaxis.set_major_locator(MaxNLocator(6))
    eyes.yaxis.set_major_formatter("{x:g}")
    for axes in (eyes, rest):
        axes.set(xlabel="optimiser step")
        axes.grid(alpha=0.3)
        if axes.lines:
            # Below the curves, which leave no corner free.
            axes.legend(
                frameon=False, fontsize=8, ncols=2, loc="upper center", bbox_to_anchor=(0.5, -0.18)
            )
    _draw_rounds(played, rounds)
    target = out / "training" / PICTURE
    with replacing(target) as temporary:
        figure.savefig(temporary, format="png", dpi=110)
    return target


def read_curves(folder: Path) -> dict[str, Curve]:
    """Every scalar that TensorBoard holds.

    Args:
        folder: Of its files.

    Returns:
        Name to steps (n,) and values (n,).
    """
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    # A resumed run has a file a sitting, which is no cause for alarm.
    logging.getLogger("tensorboard").setLevel(logging.ERROR)
    events = EventAccumulator(str(folder), size_guidance={"scalars": 0})
    events.Reload()
    return {
        name: (
            np.array([event.step for event in events.Scalars(name)]),
            np.array([event.value for event in events.Scalars(name)]),
        )
        for name in events.Tags()["scalars"]
    }


def _rounds(folder: Path) -> list[dict[str, Any]]:
    """What the rounds came to, in order."""
    paths = sorted(folder.glob("round-*/round.json"), key=lambda p: int(p.parent.name[6:]))
    return [json.loads(path.read_text()) for path in paths]


def _draw(
    axes: "Axes", curves: dict[str, Curve], names: dict[str, str], linestyle: str = "-"
) -> None:
    for key, name in names.items():
        if key not in curves:
            continue
        steps, values = curves[key]
        if key.startswith("train/") and len(values) >= SMOOTHED_POINTS:
            weights = np.full(SMOOTHED_POINTS, 1.0 / SMOOTHED_POINTS)
            values = np.convolve(values, weights, mode="valid")
            steps = steps[SMOOTHED_POINTS - 1 :]
        axes.plot(steps, values, label=name, linewidth=1.2, linestyle=linestyle)


def _draw_rounds(axes: "Axes", rounds: list[dict[str, Any]]) -> None:
    axes.set_title("DAgger rounds: episodes solved")
    if not rounds:
        axes.text(0.5, 0.5, "none", ha="center", va="center", transform=axes.transAxes)
        axes.set_axis_off()
        return
    numbers = np.arange(1, len(rounds) + 1)
    shares = [100.0 * r["successes"] / r["episodes"] for r in rounds]
    bars = axes.bar(numbers, shares, color="tab:green")
    axes.bar_label(bars, [f"{share:.0f} %" for share in shares], fontsize=8)
    axes.set(xlabel="round", ylabel="solved (%)", ylim=(0.0, 110.0), xticks=numbers)
