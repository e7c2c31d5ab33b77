"""What the commands that learn by reward share: a budget by default, and how a run is shown."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hvs_suite.cli import console

if TYPE_CHECKING:
    from hvs_suite.policies.rl.outcome import Outcome

DEFAULT_MINUTES = 40.0


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
