"""The model card: what a checkpoint of ours is, how it was made, and how well it does.

``README.md`` with the front matter that the Hub reads, written into the checkpoint's folder beside
the picture of its training.
"""

import json
import shutil
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from hvs_suite.datasets.metadata import EXPERT
from hvs_suite.errors import PolicyError, first_line
from hvs_suite.files import replacing
from hvs_suite.policies.checkpoints.files import FILES, MOST_SETTINGS_BYTES, home, read_config
from hvs_suite.policies.training.plot import PICTURE
from hvs_suite.reading import check_regular, read_bytes
from hvs_suite.registry import find
from hvs_suite.tasks.shared.option_types import listed

CARD = "README.md"
LICENCE = "apache-2.0"
TRAINING_FILES = ("train_config.json", "training/outcome.json", f"training/{PICTURE}")


def write_card(folder: Path, results: Iterable[Mapping[str, Any]] = (), command: str = "") -> str:
    """Write a checkpoint's card.

    Args:
        folder: The checkpoint, as `pretrain` or `finetune` leaves it.
        results: Result files of `hvs evaluate`, parsed, that speak of these weights.
        command: That made the checkpoint; empty if it is not known.

    Returns:
        The card's text without its front matter.

    Raises:
        PolicyError: The folder holds no checkpoint of either.
        OutputError: It cannot be written.
    """
    config = read_config(folder)
    trained, outcome = (_read(folder, name) for name in TRAINING_FILES[:2])
    try:
        body = describe(config, trained, outcome, list(results), command)
        task = trained["settings"]["task"]
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise PolicyError(
            f"{folder} holds no finished training run: its notes lack {first_line(error)}"
        ) from error
    with replacing(folder / CARD) as temporary:
        temporary.write_text(_front_matter(task) + body, encoding="utf-8")
    return body


def ship(checkpoint: Path, folder: Path) -> None:
    """Copy what others need of a training run: weights, settings and how it went.

    Args:
        checkpoint: The run's folder.
        folder: Gets the files; those of the same names are replaced.

    Raises:
        PolicyError: The run is not finished, or `read_config` refuses its checkpoint.
        OutputError: The folder cannot be written.
    """
    for name in (*FILES, *TRAINING_FILES):
        if not (checkpoint / name).is_file():
            raise PolicyError(f"{checkpoint} lacks {name}; let its training come to its end first")
    read_config(checkpoint)
    for name in TRAINING_FILES:
        check_regular(checkpoint / name, error=PolicyError, within=home(checkpoint, name))
    for name in (*FILES, *TRAINING_FILES):
        with replacing(folder / name) as temporary:
            shutil.copyfile(checkpoint / name, temporary)


def describe(
    config: Mapping[str, Any],
    trained: Mapping[str, Any],
    outcome: Mapping[str, Any],
    results: list[Mapping[str, Any]],
    command: str,
) -> str:
    """The card's text, Markdown.

    Args:
        config: The checkpoint's ``config.json``.
        trained: Its ``train_config.json``.
        outcome: Its ``training/outcome.json``.
        results: As in `write_card`.
        command: As in `write_card`.
    """
    settings = trained["settings"]
    was_fine_tuned = "base" in settings
    inputs = ", ".join(
        f"`{key}` {' x '.join(map(str, value['shape']))}"
        for key, value in sorted(config["input_features"].items())
    )
    # Fine-tuning has options of its own; of training, the configuration keeps them.
    options = settings.get("options", config.get("options", {}))
    spec = find(settings["task"]).with_options(options)
    words = spec.describe()
    named = f"`{settings['task']}`"
    if options:
        named += f" with `{listed(options)}`"
    rows = {
        "trained on": f"{named}, split `train` alone",
        "task": f"{spec.instruction()} Target: {words.target}; within {words.tolerance}",
        "inputs": inputs,
        "output": "`action` 7: joint position targets in units of the joint range",
        **(_rl_rows(settings, outcome) if was_fine_tuned else _imitation_rows(trained, outcome)),
        "time": _time(outcome, trained, was_fine_tuned),
        "seed": str(settings["seed"]),
        "licence": LICENCE,
    }
    lines = [
        f"# hvs policy for {settings['task']}",
        "",
        "Two camera images and the joints in, seven joint position targets out: a LeRobot policy "
        f"of type `{config['type']}` that brings the tool of a simulated KUKA LBR iiwa 7 to its "
        "target.",
        "",
        f"![Losses and rounds of the training](training/{PICTURE})",
        "",
        "| | |",
        "|---|---|",
        *(f"| {name} | {value} |" for name, value in rows.items()),
        "",
        *_results(results),
    ]
    if command:
        lines += ["Made by:", "", "```sh", command, "```", ""]
    lines += [
        "Limits: it knows this cell alone (the robot, the cameras' nominal places) and the task "
        "that it was trained on, with those options, at control steps of "
        f"{spec.control_period_s:g} s, and was never on a real robot. Outside of the ring of "
        "targets that the task draws from, anything may happen.",
        "",
    ]
    return "\n".join(lines)


def _imitation_rows(trained: Mapping[str, Any], outcome: Mapping[str, Any]) -> dict[str, str]:
    """What `pretrain` did."""
    settings = trained["settings"]
    # Runs from before this was noted learned from the expert.
    demonstrator = trained.get("demonstrator", EXPERT)
    by_expert = demonstrator == EXPERT
    action = "the expert's action" if by_expert else "the demonstrator's action"
    # Runs from before there was a choice had this one.
    teacher = settings.get("dagger_teacher", "demonstrator")
    rounds = outcome["rounds"]
    corrected = sum(played["frames"] for played in rounds)
    return {
        "parameters": f"{outcome['n_parameters']:,}",
        "demonstrations": "of the suite's expert" if by_expert else f"of `{demonstrator}`",
        "DAgger": f"{len(rounds)} rounds, {corrected:,} frames played by the policy itself under "
        f"the labels of the {teacher}"
        if rounds
        else "none",
        "optimiser steps": f"{outcome['step']:,}, in turns of the eyes on "
        f"{settings['batch_size']} frames and of the rest on {settings['windows']} windows of "
        f"{settings['window_steps']} frames",
        "supervision in training": f"{action}, and where the target is (`privileged.*`); neither "
        "is an input",
    }


def _rl_rows(settings: Mapping[str, Any], outcome: Mapping[str, Any]) -> dict[str, str]:
    """What `finetune` or `finetune-way` did."""
    fine_tuned = {
        "fine-tuned from": f"a pretrained policy, weights `{settings['base'][:12]}`",
    }
    played = f"{outcome['env_steps']:,} environment steps"
    if "population" in settings:
        return fine_tuned | {
            "reinforcement learning": "policy search (CMA-ES) on how the head chooses among its "
            f"proposals far from the goal: {outcome['n_parameters']} numbers, {played}, "
            f"{outcome['step']} generations of {settings['population']} candidates in "
            f"{settings['scenes']} scenes",
            "supervision in training": "how many control steps end outside the tolerances; no "
            "expert, and none of it is an input",
        }
    return fine_tuned | {
        "reinforcement learning": "TD3 on a residual that moves the believed goal, of "
        f"{outcome['n_parameters']:,} parameters, {played}, "
        f"{outcome['step']:,} updates of "
        f"{settings['batch_size']} transitions",
        "supervision in training": "the task's sparse reward, and critics that see the simulator's "
        "state; no expert, and none of it is an input",
    }


def _time(outcome: Mapping[str, Any], trained: Mapping[str, Any], was_fine_tuned: bool) -> str:
    """Hours of playing and learning; imitation counts its playing apart."""
    hours = (outcome["train_s"] + outcome.get("play_s", 0.0)) / 3600.0
    if was_fine_tuned:
        if "environments" in trained["settings"]:
            players, meanwhile = trained["settings"]["environments"], " while one learns"
        else:
            players, meanwhile = trained["players"], ""
        where = f"{_count(players, 'process', 'processes')} playing{meanwhile}"
        return f"{hours:.2f} h, {where}; evaluations not counted"
    learning = _count(trained["threads"], "thread", "threads")
    return f"{hours:.2f} h, learning on {learning}; recording not counted"


def _count(number: int, one: str, many: str) -> str:
    return f"one {one}" if number == 1 else f"{number} {many}"


def _results(results: list[Mapping[str, Any]]) -> list[str]:
    """A table of scores, or that there are none."""
    if not results:
        return ["Not scored yet: see `hvs evaluate`.", ""]
    lines = [
        "| task | split | solved | 95 % interval | collisions | steps | settled |",
        "|---|---|---|---|---|---|---|",
    ]
    for result in sorted(results, key=lambda each: str(each["summary"]["task"])):
        summary = result["summary"]
        spec = find(summary["task"])
        [metric] = (m for m in spec.metrics if m.name == spec.headline[0])
        low, high = summary["pc_success_ci95"]
        steps = summary["steps_to_goal_mean"]
        settled = summary["settled"]["errors"][metric.name]["iqm"]
        changed = listed(result["metadata"]["options"])
        played = f"`{summary['task']}`" + (f" with `{changed}`" if changed else "")
        lines.append(
            f"| {played} | `{summary['split']}` | {summary['n_success']:,} of "
            f"{summary['n_episodes']:,} ({summary['pc_success']:.1f} %) | {low:.1f} to {high:.1f} "
            f"% | {summary['n_collision']} | {'-' if steps is None else f'{steps:.1f}'} | "
            f"{metric.title} {settled:.3f} {metric.unit} |"
        )
    return [*lines, ""]


def _front_matter(task: str) -> str:
    """The YAML that the Hub reads."""
    tags = ("LeRobot", "robotics", "visual-servoing", "kuka-lbr-iiwa", "hvs-suite", task)
    lines = ["---", f"license: {LICENCE}", "library_name: lerobot", "pipeline_tag: robotics"]
    return "\n".join([*lines, "tags:", *(f"- {tag}" for tag in tags), "---", "", ""])


def _read(folder: Path, name: str) -> dict[str, Any]:
    content = read_bytes(
        folder / name, most=MOST_SETTINGS_BYTES, error=PolicyError, within=home(folder, name)
    )
    try:
        # NaN stands for a loss that was not measured.
        return dict(json.loads(content))
    except (ValueError, TypeError, RecursionError) as error:
        raise PolicyError(f"{folder} holds no finished training run: no readable {name}") from error
