"""Actors of a Ray cluster give what local processes give, whatever happens to them."""

import contextlib
import dataclasses
import functools
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from test_rollout import Counter, Echo, as_plain, breaks, no_weights, where

from hvs_suite import on_ray
from hvs_suite.cli.main import run
from hvs_suite.errors import ClusterError, OptionError, PolicyError
from hvs_suite.executor import TOLD_AHEAD, Note, spread
from hvs_suite.on_ray import RayCluster
from hvs_suite.policies.context import Blindfolded
from hvs_suite.rollout import carried, play, rollout

pytestmark = pytest.mark.timeout(300)
WAIT_LIMIT_S = 60.0


@pytest.fixture(scope="module")
def cluster() -> Iterator[RayCluster]:
    """Two actors of a cluster of this machine alone."""
    os.environ["RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"] = "0"
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    ray = pytest.importorskip("ray")
    ray.init(
        "local",
        num_cpus=2,
        include_dashboard=False,
        object_store_memory=150 * 2**20,
        log_to_driver=False,
        logging_level="error",
    )
    yield RayCluster("auto")
    ray.shutdown()


@dataclasses.dataclass(frozen=True)
class Counts:
    """Notes each call in a folder; how many had begun at that time, and been read."""

    folder: str

    def __call__(self, env: Counter, policy: Echo, scenario: int) -> tuple[int, int]:
        begun = Path(self.folder) / "begun"
        begun.mkdir(exist_ok=True)
        (begun / f"{scenario}-{os.getpid()}").touch()
        n_read = len(list((Path(self.folder) / "read").iterdir()))
        return scenario, len(list(begun.iterdir())) - n_read


@dataclasses.dataclass(frozen=True)
class Dies:
    """Ends its process in scenario 2: the first time, or whenever there is no file to make."""

    mark: str | None

    def __call__(self, env: Counter, policy: Echo, scenario: int) -> int:
        if scenario == 2:
            if self.mark is None:
                os._exit(7)
            try:
                Path(self.mark).touch(exist_ok=False)
            except FileExistsError:
                return scenario
            os._exit(7)
        return scenario


class Closing(Counter):
    """A cell that leaves a file when it is closed."""

    def __init__(self, folder: str) -> None:
        super().__init__()
        self.folder = folder

    def close(self) -> None:
        (Path(self.folder) / str(os.getpid())).touch()


def test_actors_give_the_episodes_that_one_process_gives(cluster: RayCluster) -> None:
    scenarios = [5, 0, 3, 1, 4, 2]
    alone = rollout(Counter, Echo, scenarios)
    seen: list[int] = []
    there = rollout(
        Counter, Echo, scenarios, workers=cluster, on_episode=lambda e: seen.append(e.scenario)
    )
    assert [as_plain(e) for e in there] == [as_plain(e) for e in alone]
    assert sorted(seen) == sorted(scenarios)


def test_actors_are_other_processes_held_to_one_thread(cluster: RayCluster) -> None:
    played = play(Counter, Echo, range(1000), where, workers=cluster)
    places = {next(played) for _ in range(100)}
    assert {threads for _, threads in places} == {"1"}
    processes = {process for process, _ in places}
    assert os.getpid() not in processes
    # Leaving the iterator ends them.
    played.close()
    end = time.monotonic() + WAIT_LIMIT_S
    while any(Path(f"/proc/{process}").exists() for process in processes):
        assert time.monotonic() < end


def test_a_typed_error_keeps_its_type(cluster: RayCluster) -> None:
    with pytest.raises(PolicyError, match=r"^No weights are shipped for this task\.$"):
        rollout(Counter, no_weights, range(3), workers=cluster)


@pytest.mark.slow
def test_another_error_of_an_actor_comes_with_its_traceback(cluster: RayCluster) -> None:
    with pytest.raises(RuntimeError, match="ZeroDivisionError: by accident") as caught:
        rollout(Counter, breaks, range(3), workers=cluster)
    assert "in breaks" in caught.value.__notes__[0]


def test_what_an_actor_that_died_held_is_played_by_others(
    cluster: RayCluster, tmp_path: Path
) -> None:
    played = play(Counter, Echo, range(12), Dies(str(tmp_path / "mark")), workers=cluster)
    assert sorted(played) == list(range(12))
    assert (tmp_path / "mark").exists()


@pytest.mark.slow
def test_a_scenario_that_ends_every_actor_is_named(cluster: RayCluster) -> None:
    with pytest.raises(RuntimeError, match="ended 3 times at number 2"):
        list(play(Counter, Echo, range(6), Dies(None), workers=cluster))


def test_actors_run_no_further_ahead_than_they_are_told(
    cluster: RayCluster, tmp_path: Path
) -> None:
    (tmp_path / "read").mkdir()
    ahead = []
    for scenario, unread in play(Counter, Echo, range(60), Counts(str(tmp_path)), workers=cluster):
        ahead.append(unread)
        (tmp_path / "read" / str(scenario)).touch()
    assert len(ahead) == 60
    # The reader notes a result only after the next index is on its way.
    assert max(ahead) <= 2 * TOLD_AHEAD + 2


@dataclasses.dataclass(frozen=True)
class FirstIsLong:
    """A worker that has much to do at index 0 and nothing at others."""

    @contextlib.contextmanager
    def __call__(self, note: Note) -> Iterator[Callable[[int], int]]:
        def call(index: int) -> int:
            note(index)
            return index + 0 * sum(range(10**8 if index == 0 else 1))

        yield call


@pytest.mark.parametrize("ahead", [1, pytest.param(3, marks=pytest.mark.slow)])
def test_no_actor_is_far_ahead_of_the_oldest_that_is_not_done(
    cluster: RayCluster, monkeypatch: pytest.MonkeyPatch, ahead: int
) -> None:
    monkeypatch.setattr(on_ray, "OUT_OF_TURN", 4)
    said: list[int] = []
    found: list[int] = []
    for index in spread(
        FirstIsLong(), range(40), workers=cluster, ahead=ahead, on_note=said.append
    ):
        assert index < min(set(range(40)) - set(found)) + 2 * 4
        found.append(index)
    assert sorted(found) == list(range(40))
    # What was said last may not have come before the end.
    assert set(said) <= set(found)
    assert 0 in said


@pytest.mark.slow
def test_environments_are_closed_in_the_end(cluster: RayCluster, tmp_path: Path) -> None:
    make = functools.partial(Closing, str(tmp_path))
    places = {process for process, _ in play(make, Echo, range(20), where, workers=cluster)}
    assert {int(path.name) for path in tmp_path.iterdir()} >= places


def test_a_machine_with_other_packages_is_refused(
    cluster: RayCluster, monkeypatch: pytest.MonkeyPatch
) -> None:
    here = on_ray.installed() | {"mujoco": "3.0.0"}
    monkeypatch.setattr(on_ray, "installed", lambda: here)
    with pytest.raises(ClusterError, match=r"127\.0\.0\.1 .* has mujoco .*, and this one 3\.0\.0"):
        rollout(Counter, Echo, range(2), workers=cluster)


def test_a_factory_that_cannot_travel_is_refused(cluster: RayCluster) -> None:
    lock = threading.Lock()
    with pytest.raises(OptionError, match="travel"):
        list(play(lambda: lock, Echo, range(2), where, workers=cluster))  # type: ignore[arg-type, return-value]


@dataclasses.dataclass(frozen=True)
class ReadsFolder:
    """A policy factory that reads a file when it is called."""

    folder: str

    def __call__(self, env: Any) -> Any:
        return sorted(
            (path.name, path.read_text()) for path in Path(self.folder).iterdir() if path.is_file()
        )


def test_the_files_of_a_checkpoint_travel_with_it(tmp_path: Path) -> None:
    folder = tmp_path / "policy"
    (folder / "training").mkdir(parents=True)
    (folder / "weights").write_text("1 2 3")
    (folder / "config").write_text("{}")
    make = carried(ReadsFolder(str(folder)))
    wrapped = carried(Blindfolded(ReadsFolder(str(folder))))
    folder.rename(tmp_path / "gone")
    found = [("config", "{}"), ("weights", "1 2 3")]
    assert make(None) == found  # type: ignore[comparison-overlap]
    assert wrapped.make(None) == found  # type: ignore[attr-defined]
    assert carried(Echo) is Echo  # type: ignore[arg-type, comparison-overlap]


@pytest.mark.parametrize("workers", [0, -1])
def test_less_than_one_actor_is_refused(workers: int) -> None:
    with pytest.raises(OptionError, match="at least 1"):
        RayCluster("auto", workers)


@pytest.mark.parametrize(
    ("address", "reason"), [("127.0.0.1:1", "no Ray cluster answers"), ("nowhere", "'nowhere'")]
)
def test_a_cluster_that_is_not_there_is_one_line(address: str, reason: str, tmp_path: Path) -> None:
    words = ["evaluate", "--policy", "zero", "--task", "align-easy", "--ray", address]
    words += ["--out", str(tmp_path / "result.json")]
    # Elsewhere: this process may have joined a cluster, and one is all that it can join.
    done = subprocess.run(
        [sys.executable, "-c", f"from hvs_suite.cli.main import main; main({words!r})"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 2
    assert reason in done.stderr
    assert done.stderr.count("\n") == 1


def test_without_ray_a_command_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    words = ["check", str(tmp_path), "--ray", "auto"]
    assert run(words) == 2
    assert "hvs-suite[ray]" in capsys.readouterr().err
