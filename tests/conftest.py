"""What the rooms' tests share: named tasks that are loaded once a process.

Sharing them is safe because a scenario depends on nothing that ran before, which
``tests/cell/test_environment.py`` proves with environments of its own.
"""

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

import pytest

import hvs_suite

if TYPE_CHECKING:
    from hvs_suite.tasks.shared.environment import Environment


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
