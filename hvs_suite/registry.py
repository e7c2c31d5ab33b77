"""The registry: makes environments from task names.

The suite's own families are imported here, the only place above ``tasks`` that names them; those of
other packages are found by their entry points (see `hvs_suite.tasks.shared.family`).
"""

import dataclasses
import difflib
import functools
import json
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

import hvs_suite.tasks.align
import hvs_suite.tasks.clutter
import hvs_suite.tasks.insert
import hvs_suite.tasks.sequence
import hvs_suite.tasks.surface
import hvs_suite.tasks.track  # noqa: F401 - each registers its tasks
from hvs_suite.errors import OptionError, UnknownTaskError
from hvs_suite.tasks.shared import family
from hvs_suite.tasks.shared.spec import Spec

if TYPE_CHECKING:
    from hvs_suite.tasks.shared.arm_task import ArmTask
    from hvs_suite.tasks.shared.environment import Environment


class _Tasks(Mapping[str, Spec]):
    """What each registered name stands for; a view that grows when a family is registered."""

    def __getitem__(self, name: str) -> Spec:
        return _all()[name].spec

    def __iter__(self) -> Iterator[str]:
        return iter(_all())

    def __len__(self) -> int:
        return len(_all())

    def __repr__(self) -> str:
        return f"TASKS({', '.join(self)})"


TASKS: Mapping[str, Spec] = _Tasks()
"""The named tasks, family by family, the easiest of each first."""


def find(name: str) -> Spec:
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


def options_of(spec: Spec) -> dict[str, Any]:
    """The options by which a spec differs from the task that it is named after.

    Args:
        spec: Parameters, of a named task or changed from one.

    Returns:
        Values by name, as JSON gives them back, so that written and fresh ones compare equal; empty
        for the task as named.

    Raises:
        UnknownTaskError: The spec's name is not registered.
    """
    named = find(spec.name)
    options = {
        field.name: getattr(spec, field.name)
        for field in dataclasses.fields(spec)
        if getattr(spec, field.name) != getattr(named, field.name)
    }
    found: dict[str, Any] = json.loads(json.dumps(options))
    return found


def announced(spec: Spec) -> Spec:
    """What policies are told of a task that they play.

    Args:
        spec: Parameters, of a named task or changed from one.

    Returns:
        The same parameters; those of the named task if the changes are unannounced.

    Raises:
        UnknownTaskError: The spec's name is not registered.
    """
    return find(spec.name) if spec.unannounced else spec


def family_of(name: str) -> type[family.Family[Any, Any]]:
    """The class that plays a named task.

    Args:
        name: Registered name.

    Raises:
        UnknownTaskError: There is no such task.
    """
    find(name)
    return _all()[name].family


def make_task(spec: Spec, split: str) -> "ArmTask":
    """The task behind an environment.

    Args:
        spec: Parameters, of a named task or changed from one.
        split: Name of the stream of scenarios.

    Raises:
        UnknownTaskError: The spec's name is not registered.
        OptionError: The spec cannot be fulfilled.
        ScenarioError: The split's name is empty.
    """
    from hvs_suite.tasks.shared.arm_task import ArmTask

    return ArmTask(family_of(spec.name)(spec, find(spec.name)), split)


def load(
    name: str, *, split: str = "train", seed: int | None = None, **options: Any
) -> "Environment":
    """Load a named task as a ``dm_control.composer.Environment``.

    Args:
        name: Registered name, one of ``hvs_suite.TASKS``.
        split: Stream of scenarios: ``test`` holds 1,000 frozen ones, any other name is unbounded.
        seed: Start of the stream that bare ``reset()`` calls walk, from 0 up; None draws one.
        **options: Any field of the task's spec, for studies; a named task fixes all of them.

    Returns:
        The environment; play scenario i with ``reset(scenario=i)``.

    Raises:
        UnknownTaskError: There is no such task.
        OptionError: An option does not exist or its value makes no sense.
        ScenarioError: The split's name is empty.
    """
    spec = find(name).with_options(options)
    if seed is not None and (isinstance(seed, bool) or not isinstance(seed, int) or seed < 0):
        raise OptionError(f"seed is {seed!r}; use a whole number from 0 up, or None")
    # MuJoCo takes half a second to import, which listing tasks does not need.
    from hvs_suite.tasks.shared.environment import Environment

    return Environment(make_task(spec, split), seed=seed)


def _all() -> Mapping[str, family.Registered]:
    _discover()
    return family.registered()


@functools.cache
def _discover() -> None:
    family.discover()
