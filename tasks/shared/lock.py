"""The version lock: what each task name means, as digests that the tests hold the code against.

``lock.json`` holds, for every named task, its version and three digests: of its parameters, of the
robot, and of its 1,000 test scenarios. Changing what a name means changes a digest and fails the
tests until the version is raised and ``make certificates`` has written the lock anew.
"""

import dataclasses
import functools
import hashlib
import importlib.resources
import json
from typing import TYPE_CHECKING, Any

from hvs_suite.tasks.shared.spec import Spec

if TYPE_CHECKING:
    from hvs_suite.tasks.shared.scenario import ScenarioSource


@dataclasses.dataclass(frozen=True)
class LockEntry:
    """What a name means.

    Attributes:
        version: Version of the task.
        parameters: SHA-256 of the variant's fields.
        robot: SHA-256 of the robot's MJCF: chain, inertia, gains, collision bodies.
        test_scenarios: SHA-256 of the digests of all test scenarios in order.
    """

    version: int
    parameters: str
    robot: str
    test_scenarios: str

    @property
    def digest(self) -> str:
        """One SHA-256 for all of it."""
        return _sha256(json.dumps(dataclasses.asdict(self), sort_keys=True))


@functools.cache
def lock() -> dict[str, LockEntry]:
    """The entries of ``lock.json`` by task name."""
    path = importlib.resources.files("hvs_suite.tasks") / "lock.json"
    entries = json.loads(path.read_text(encoding="utf-8"))
    return {name: LockEntry(**entry) for name, entry in entries.items()}


def digest(task: str) -> str:
    """The digest that results and datasets carry.

    Args:
        task: Registered name.

    Returns:
        SHA-256, hexadecimal.
    """
    return lock()[task].digest


def compute_entry(variant: Spec, source: "ScenarioSource") -> LockEntry:
    """Compute what a variant means now.

    Args:
        variant: A named task's parameters.
        source: Its test split.

    Returns:
        The entry; draws all test scenarios, which takes seconds.
    """
    from hvs_suite.cell.robot import robot_mjcf
    from hvs_suite.tasks.shared.scenario import TEST_SCENARIOS

    scenarios = "".join(source.draw(index).digest() for index in range(TEST_SCENARIOS))
    return LockEntry(
        version=variant.version,
        parameters=_sha256(json.dumps(_fields(variant), sort_keys=True)),
        robot=_sha256(robot_mjcf()),
        test_scenarios=_sha256(scenarios),
    )


def _fields(variant: Spec) -> dict[str, Any]:
    return dataclasses.asdict(variant)


def _sha256(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()
