"""The version lock: digests of what each task name means, which the tests compare with the code.

``tasks/lock.json`` holds, for every named task, its version and the digests of what makes it: the
parameters, the robot, the scene, the test scenarios and the rule of success. Changing what a name
means changes a digest and fails the tests until the version is raised and ``hvs certify`` has
written the lock anew.
"""

import dataclasses
import functools
import hashlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hvs_suite.errors import LockError
from hvs_suite.files import replacing
from hvs_suite.tasks.shared.family import Registered, registered
from hvs_suite.tasks.shared.spec import Spec

if TYPE_CHECKING:
    from hvs_suite.tasks.shared.environment import Environment

FILE = Path(__file__).resolve().parents[1] / "lock.json"

_SHARES = (0.0, 0.99, 1.01)
"""Where the tip is put to find out how success is judged: shares of the position's bound."""
_SCRIPTED_STEPS = 90
_TEXTURE_SEED = 0


@dataclasses.dataclass(frozen=True)
class LockEntry:
    """What a name means, as SHA-256 digests.

    Attributes:
        version: Version of the task.
        parameters: Of its family and of the parameters that differ from the family's defaults, so
            that a new parameter does not change what it leaves alone.
        robot: Of the robot's MJCF as the task has it: chain, inertia, gains, collision bodies,
            tool.
        scene: Of the whole cell's MJCF (markers, light, cameras, materials, meshes), and of one
            painted texture where textures vary.
        test_scenarios: Of the digests of all test scenarios in order.
        rule: Of how scripted episodes are judged: held, solved, over.
    """

    version: int
    parameters: str
    robot: str
    scene: str
    test_scenarios: str
    rule: str

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
        SHA-256, hexadecimal. Our own tasks' are locked; that of a task of another package is what
        it means now, computed anew by each process that asks (seconds).

    Raises:
        LockError: The lock has no such task of ours.
    """
    if task in lock():
        return lock()[task].digest
    if is_own(task):
        raise LockError(
            f"task {task!r} is not in the version lock; certify it with 'hvs certify {task}'"
        )
    return _computed_digest(registered()[task])


def is_own(task: str) -> bool:
    """Whether a task belongs into this lock: one that no other package registers.

    Args:
        task: Name of a task.
    """
    known = registered().get(task)
    return known is None or known.family.__module__.partition(".")[0] == "hvs_suite"


@functools.cache
def _computed_digest(task: Registered) -> str:
    from hvs_suite.tasks.shared.arm_task import ArmTask
    from hvs_suite.tasks.shared.environment import Environment
    from hvs_suite.tasks.shared.scenario import TEST_SPLIT

    family = task.family(task.spec, task.spec)
    with Environment(ArmTask(family, TEST_SPLIT)) as env:
        return compute_entry(env).digest


def compute_entry(env: "Environment") -> LockEntry:
    """Compute what a task means now.

    Args:
        env: The named task on its test split.

    Returns:
        The entry; draws all test scenarios, which takes seconds.
    """
    from hvs_suite.cell.robot import robot_mjcf
    from hvs_suite.tasks.shared.scenario import TEST_SCENARIOS

    source = env.task.source
    scenarios = "".join(source.draw(index).digest() for index in range(TEST_SCENARIOS))
    return LockEntry(
        version=env.spec.version,
        parameters=_sha256(json.dumps(_parameters(env.spec), sort_keys=True)),
        robot=_sha256(robot_mjcf(env.spec.embodiment)),
        scene=_sha256(_scene(env)),
        test_scenarios=_sha256(scenarios),
        rule=_sha256(json.dumps(list(_judged(env)))),
    )


def agreed_entry(env: "Environment") -> LockEntry:
    """Compute what a task means now, and compare it with the lock.

    Args:
        env: The named task on its test split.

    Returns:
        The entry that may be stored.

    Raises:
        LockError: The lock says something else of the same or a later version.
    """
    name, version = env.spec.name, env.spec.version
    entry, locked = compute_entry(env), lock().get(name)
    if locked is not None and entry != locked and entry.version <= locked.version:
        changed = ", ".join(
            field.name
            for field in dataclasses.fields(LockEntry)
            if getattr(entry, field.name) != getattr(locked, field.name)
        )
        raise LockError(
            f"{name}-v{version} no longer means what the version lock says "
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
    with replacing(FILE) as path:
        # In the order in which tasks are listed, whatever was certified last.
        order = [*(name for name in registered() if name in entries), *entries]
        content = {name: dataclasses.asdict(entries[name]) for name in dict.fromkeys(order)}
        path.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
    lock.cache_clear()


def _parameters(spec: Spec) -> dict[str, Any]:
    """Family, class of parameters, and every parameter that differs from its default."""
    return {"family": spec.family} | {
        field.name: getattr(spec, field.name)
        for field in dataclasses.fields(spec)
        if getattr(spec, field.name) != field.default
    }


def _scene(env: "Environment") -> str:
    """The cell as text; numbers to eight digits, which no processor rounds differently."""
    from hvs_suite.tasks.shared.appearance import surface_texture

    text: str = env.task.root_entity.mjcf_model.to_xml_string(precision=8, zero_threshold=1e-10)
    if env.spec.vary_texture:
        text += _sha256(surface_texture(_TEXTURE_SEED).tobytes().hex())
    return text


def _judged(env: "Environment") -> Iterator[tuple[Any, ...]]:
    """How the task judges a tip that is put inside or outside its bounds, step by step.

    The arm stays where it is: what is looked at is the rule, and no physics.
    """
    env.draws = False
    for share in _SHARES:
        for rest in (0, 7):
            env.reset(scenario=0)
            for step in range(1, min(_SCRIPTED_STEPS, env.spec.time_limit_steps) + 1):
                # With a rest, every so many steps the tip is far away.
                away = 2.0 if rest and step % rest == 0 else share
                yield env.judge(away, step)
                if env.task.has_ended:
                    break
    env.draws = True


def _sha256(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()
