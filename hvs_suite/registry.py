"""The registry: from a task's name to a ready environment."""

import difflib
from typing import TYPE_CHECKING, Any

from hvs_suite.errors import OptionError, UnknownTaskError
from hvs_suite.tasks.variants import TASKS, AlignVariant, with_options

if TYPE_CHECKING:
    from hvs_suite.cell.environment import Environment


def find(name: str) -> AlignVariant:
    """Parameters of a named task.

    Args:
        name: Registered name, such as ``align-thesis``.

    Raises:
        UnknownTaskError: There is no such task; the text offers the nearest names.
    """
    if name in TASKS:
        return TASKS[name]
    close = difflib.get_close_matches(str(name), TASKS, n=3, cutoff=0.5)
    hint = f"did you mean {' or '.join(close)}?" if close else f"choose from {', '.join(TASKS)}"
    raise UnknownTaskError(f"unknown task {name!r}; {hint}")


def load(
    name: str, *, split: str = "train", seed: int | None = None, **options: Any
) -> "Environment":
    """Load a named task as a ``dm_control.composer.Environment``.

    Args:
        name: Registered name, one of ``hvs_suite.TASKS``.
        split: Stream of scenarios: ``test`` holds 1,000 frozen ones, any other name is unbounded.
        seed: Start of the stream that bare ``reset()`` calls walk, from 0 up; None draws one.
        **options: Any field of ``AlignVariant``, for studies; a named task fixes all of them.

    Returns:
        The environment; play scenario i with ``reset(scenario=i)``.

    Raises:
        UnknownTaskError: There is no such task.
        OptionError: An option does not exist or its value makes no sense.
        ScenarioError: The split's name is empty.
    """
    variant = with_options(find(name), options)
    if seed is not None and (isinstance(seed, bool) or not isinstance(seed, int) or seed < 0):
        raise OptionError(f"seed is {seed!r}; use a whole number from 0 up, or None")
    # MuJoCo takes half a second to import: listing tasks must not pay for it.
    from hvs_suite.cell.environment import Environment
    from hvs_suite.tasks.align import Align

    return Environment(Align(variant, split), seed=seed)
