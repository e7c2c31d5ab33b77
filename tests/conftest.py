"""What the rooms' tests share: named tasks, which to play and loaded once a process.

Sharing them is safe because a scenario depends on nothing that ran before, which
``tests/cell/test_environment.py`` proves with environments of its own.
"""

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

import pytest

import hvs_suite
import hvs_suite.cell  # chooses the OpenGL backend before a test module imports MuJoCo

if TYPE_CHECKING:
    from hvs_suite.tasks.shared.environment import Environment


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line(
        "markers",
        "each_task(*also, family=None, measures=None): play every named task (of a family, or that "
        "measures something) as the argument task; "
        "make test plays the first of each family and those that are named, the rest are slow",
    )


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Parametrise what is marked ``each_task``."""
    marker = metafunc.definition.get_closest_marker("each_task")
    if marker is None:
        return
    asked = marker.kwargs.get("family")
    measured = marker.kwargs.get("measures")
    families = {
        name: spec.family
        for name, spec in hvs_suite.TASKS.items()
        if measured is None or measured in [metric.name for metric in spec.metrics]
    }
    firsts = {family: name for name, family in reversed(families.items())}
    quick = {*firsts.values(), *marker.args}
    metafunc.parametrize(
        "task",
        [
            pytest.param(name, marks=() if name in quick else pytest.mark.slow)
            for name, family in families.items()
            if asked in (None, family)
        ],
    )


@pytest.fixture(scope="session")
def named() -> Iterator["Callable[[str, str], Environment]"]:
    """``named(task, observations)``: a named task on its test split, seen by a preset."""
    kept: dict[tuple[str, str], Environment] = {}

    def get(task: str, observations: str = "vision") -> "Environment":
        key = (task, observations)
        if key not in kept:
            kept[key] = hvs_suite.load(task, split="test", observations=observations)
        return kept[key]

    yield get
    for env in kept.values():
        env.close()
