"""What the commands that learn by reward share: a budget by default, and how a run is shown."""

import functools
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hvs_suite.cli import console

if TYPE_CHECKING:
    from hvs_suite.policies.rl.outcome import Outcome

DEFAULT_MINUTES = 40.0


def show_finetuning(
    command: Any, settings: type[Any], train: Callable[..., "Outcome"], **options: Any
) -> None:
    """Fine-tune a policy as a command says.

    Args:
        command: With the fields of the settings, and ``policy``, ``task``, ``out``, ``option``,
            ``minutes``, ``steps``, ``seed``, ``eval_every`` and ``eval_episodes``.
        settings: Class of the method's settings.
        train: Takes base, task, folder, settings, and what `show_run` says.
        **options: What else it takes.
    """
    from hvs_suite import registry
    from hvs_suite.policies.catalogue import checkpoint_folder

    task_options = registry.find(command.task).options_from_text(command.option)
    base = checkpoint_folder(command.policy, command.task)
    chosen = {
        field.name: getattr(command, field.name)
        for field in fields(settings)
        if hasattr(command, field.name)
    }
    show_run(
        functools.partial(train, base, command.task, command.out),
        command.out,
        minutes=command.minutes,
        steps=command.steps,
        seed=command.seed,
        settings=settings(**chosen),
        options=task_options,
        eval_every=command.eval_every,
        eval_episodes=command.eval_episodes,
        **options,
    )


def show_run(
    train: Callable[..., "Outcome"],
    out: Path,
    *,
    minutes: float | None,
    steps: int | None,
    **options: Any,
) -> None:
    """Train, showing how it goes, and say what came of it.

    Args:
        train: Takes ``minutes``, ``steps``, ``on_progress`` and the options.
        out: Folder that it writes.
        minutes: Time to train (min).
        steps: Environment steps to train; without either, `DEFAULT_MINUTES` are taken.
        **options: What else it takes.
    """
    if minutes is None and steps is None:
        minutes = DEFAULT_MINUTES
    with console.meter() as update:
        outcome = train(
            minutes=minutes,
            steps=steps,
            on_progress=lambda state: update(state.stage, state.share, state.in_words()),
            **options,
        )
    print(outcome.in_words())
    print(f"wrote {out}")
