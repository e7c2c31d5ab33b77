"""The version lock: what each task name means, as digests that the tests hold the code against.

``lock.json`` holds, for every named task, its version and three digests: of its parameters, of the
robot, and of its 1,000 test scenarios. Changing what a name means changes a digest and fails the
tests until the version is raised and ``hvs certify`` has written the task's entry anew.
"""

import dataclasses
import functools
import hashlib
import json
from pathlib import Path
from typing import Any

from hvs_suite.errors import LockError
from hvs_suite.files import replacing
from hvs_suite.tasks.variants import TASKS, AlignVariant

FILE = Path(__file__).resolve().parent / "lock.json"


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
    entries = json.loads(FILE.read_text(encoding="utf-8"))
    return {name: LockEntry(**entry) for name, entry in entries.items()}


def digest(task: str) -> str:
    """The digest that results and datasets carry.

    Args:
        task: Registered name.

    Returns:
        SHA-256, hexadecimal.

    Raises:
        LockError: The lock has no such task.
    """
    if task not in lock():
        raise LockError(
            f"task {task!r} is not in the version lock; certify it with 'hvs certify {task}'"
        )
    return lock()[task].digest


def compute_entry(variant: AlignVariant) -> LockEntry:
    """Compute what a variant means now.

    Args:
        variant: A named task's parameters.

    Returns:
        The entry; draws all test scenarios, which takes seconds.
    """
    from hvs_suite.cell.robot import robot_mjcf
    from hvs_suite.cell.surface import Surface
    from hvs_suite.tasks.scenario import TEST_SCENARIOS, TEST_SPLIT, ScenarioSource

    source = ScenarioSource(variant, TEST_SPLIT, Surface(shape=variant.surface))
    scenarios = "".join(source.draw(index).digest() for index in range(TEST_SCENARIOS))
    return LockEntry(
        version=variant.version,
        parameters=_sha256(json.dumps(_fields(variant), sort_keys=True)),
        robot=_sha256(robot_mjcf()),
        test_scenarios=_sha256(scenarios),
    )


def agreed_entry(variant: AlignVariant) -> LockEntry:
    """Compute what a variant means now, and hold it against the lock.

    Args:
        variant: A named task's parameters.

    Returns:
        The entry that may be stored.

    Raises:
        LockError: The lock says something else of the same or a later version.
    """
    entry, locked = compute_entry(variant), lock().get(variant.name)
    if locked is not None and entry != locked and entry.version <= locked.version:
        changed = ", ".join(
            field.name
            for field in dataclasses.fields(LockEntry)
            if getattr(entry, field.name) != getattr(locked, field.name)
        )
        raise LockError(
            f"{variant.name}-v{variant.version} no longer means what the version lock says "
            f"(changed: {changed}); raise its version to {locked.version + 1}, then certify it"
        )
    return entry


def store(task: str, entry: LockEntry) -> None:
    """Write one task's entry; those of the other tasks stay as they are.

    Args:
        task: Registered name.
        entry: What it means, from `agreed_entry`.

    Raises:
        OutputError: The file cannot be written.
    """
    entries = lock() | {task: entry}
    order = [*(name for name in TASKS if name in entries), *(entries.keys() - TASKS.keys())]
    with replacing(FILE) as path:
        content = {name: dataclasses.asdict(entries[name]) for name in order}
        path.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
    lock.cache_clear()


def _fields(variant: AlignVariant) -> dict[str, Any]:
    return dataclasses.asdict(variant)


def _sha256(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()
