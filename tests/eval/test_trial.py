"""A policy that breaks down loses its episode and nothing else; past the goal it plays on."""

import json
import multiprocessing
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

import hvs_suite
from hvs_suite.cli import main
from hvs_suite.errors import OutputError
from hvs_suite.eval import protocol
from hvs_suite.eval.scoring import action_log, provenance, result_file
from hvs_suite.policies.catalogue import policy_factory
from hvs_suite.registry import TASKS
from hvs_suite.rollout import run_episode

TASK = "align-thesis"


@pytest.fixture(autouse=True)
def _own_code(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(Path(__file__).parent)


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("nan", "not finite"),
        ("shape", "wrong shape"),
        ("text", "wrong shape"),
        ("raises", "raised IndexError"),
        ("mute", "raised MuteError"),
        ("trap", "wrong shape"),
        ("leaves", "raised SystemExit"),
        ("interrupts", "raised KeyboardInterrupt"),
        ("ends", "process ended"),
        ("hangs", "too slow"),
    ],
)
def test_a_policy_that_breaks_down_loses_the_episode_and_the_run_goes_on(
    name: str, reason: str
) -> None:
    result = protocol.evaluate(f"broken_policies:{name}", TASK, episodes=2, decision_limit_s=0.3)
    assert result.summary.failures == {reason: 2}
    assert result.summary.n_failure == 2
    for row in result.episodes:
        assert (row.failure, row.steps, row.truncated) == (reason, 1, False)
        assert row.errors["position_error_mm"] > 0.0


def test_the_deadline_leaves_no_timer_behind() -> None:
    before = signal.getsignal(signal.SIGALRM)
    protocol.evaluate("zero", TASK, episodes=1, decision_limit_s=0.5)
    assert signal.getsignal(signal.SIGALRM) is before


def interrupted(path: Path, policy: str, episodes: int) -> Path:
    """Evaluates one episode; returns what is left of the evaluation."""

    def stop(trial: Any) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        protocol.evaluate(policy, TASK, path, episodes=episodes, progress=stop)
    return path.with_name(f"{path.name}.partial")


def test_seeds_are_a_run_s_own_and_the_same_for_any_workers_and_after_an_interruption(
    tmp_path: Path,
) -> None:
    one, two = tmp_path / "one.json", tmp_path / "two.json"
    partial = interrupted(one, "broken_policies:draws", 3)
    shutil.copy(partial, tmp_path / "two.json.partial")
    first, second, another = (
        protocol.evaluate("broken_policies:draws", TASK, out, episodes=3, workers=workers)
        for out, workers in ((one, 1), (two, 2), (tmp_path / "another.json", 1))
    )
    assert first.episodes == second.episodes
    ends = [
        {row.errors["tilt_error_deg"] for row in result.episodes} for result in (first, another)
    ]
    assert not ends[0] & ends[1]
    assert first.metadata.policy_kind == "module"
    assert first.metadata.policy_hash is not None


def test_no_policy_learns_its_scenario_by_counting() -> None:
    orders: list[list[int]] = []
    for _ in range(2):
        order: list[int] = []
        protocol.evaluate(
            "zero", TASK, episodes=20, progress=lambda trial, o=order: o.append(trial.row.scenario)
        )
        orders.append(order)
    assert orders[0] != orders[1]
    assert sorted(orders[0]) == sorted(orders[1]) == list(range(20))


def test_a_person_s_code_plays_where_nothing_of_the_simulator_is() -> None:
    result = protocol.evaluate("broken_policies:spies", TASK, episodes=1)
    assert result.summary.failures == {}


def test_what_a_policy_prints_is_no_output_of_the_evaluation(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    words = f"evaluate --policy broken_policies:shouts --task {TASK} --episodes 1"
    assert main.run([*words.split(), "--out", str(tmp_path / "out.json")]) == 0
    out, err = capfd.readouterr()
    assert "here I am" in err
    assert "here I am" not in out


def test_evaluating_leaves_the_caller_s_global_generators_alone() -> None:
    states = []
    for _ in range(2):
        states.append((random.getstate(), str(np.random.get_state())))  # noqa: NPY002
        protocol.evaluate("broken_policies:draws", TASK, episodes=1)
    assert states[0] == states[1]


def test_a_policy_sees_what_the_preset_shows_and_nothing_else() -> None:
    result = protocol.evaluate("broken_policies:curious", TASK, episodes=1)
    assert result.summary.failures == {}


@pytest.mark.parametrize(
    ("spec", "reason"),
    [
        ("no_such_module:make", "cannot import no_such_module"),
        ("broken_policies:nobody", "no callable nobody"),
        ("broken_policies:nothing", "has no reset"),
        ("broken_policies:no_arguments", "takes one PolicyContext"),
        ("broken_policies:wordless", "MuteError"),
        ("broken_policies:exits", "SystemExit"),
        ("leaves_at_once:make", "SystemExit"),
        ("interrupts_at_once:make", "KeyboardInterrupt"),
        ("ends_at_once:make", "exit code 3"),
    ],
)
def test_code_that_is_no_policy_is_refused_in_one_line_and_leaves_nothing_behind(
    spec: str,
    reason: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    code = tmp_path / "code"
    shutil.copytree(Path(__file__).parent, code, ignore=shutil.ignore_patterns("test_*", "__*"))
    (code / "leaves_at_once.py").write_text("raise SystemExit(0)")
    (code / "interrupts_at_once.py").write_text("raise KeyboardInterrupt")
    (code / "ends_at_once.py").write_text("import os; os._exit(3)")
    monkeypatch.chdir(code)
    out = tmp_path / "results" / "out.json"
    assert main.run(["evaluate", "--policy", spec, "--task", TASK, "--out", str(out)]) == 2
    (complaint,) = capsys.readouterr().err.splitlines()
    assert reason in complaint
    assert list(out.parent.iterdir()) == []


def test_a_policy_s_process_ends_with_an_evaluation_that_is_killed(tmp_path: Path) -> None:
    code = "import sys; from hvs_suite.cli.main import main; main(sys.argv[1:])"
    words = f"evaluate --policy broken_policies:lingers --task {TASK} --out {tmp_path}/out.json"
    with subprocess.Popen(
        [sys.executable, "-c", code, *words.split()], stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stderr is not None
        assert process.stderr.readline() == "at it\n"
        process.kill()
        # The policy's process writes there as well: this ends when both have.
        assert process.stderr.read() == ""


def test_a_package_around_a_policy_runs_only_where_the_policy_plays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "pack").mkdir()
    (tmp_path / "pack" / "__init__.py").write_text("import os; ran_in = os.getpid()")
    source = Path(__file__).with_name("broken_policies.py").read_text()
    (tmp_path / "pack" / "policy.py").write_text(source)
    monkeypatch.chdir(tmp_path)
    result = protocol.evaluate("pack.policy:still", TASK, episodes=1)
    assert result.summary.failures == {}
    assert result.metadata.policy_hash == provenance.file_hash(tmp_path / "pack" / "policy.py")
    assert not [name for name in sys.modules if name.partition(".")[0] == "pack"]


def test_the_score_is_the_episode_that_ends_at_the_goal() -> None:
    result = protocol.evaluate("expert", TASK, episodes=2)
    with hvs_suite.load(TASK, split="test") as env:
        expert = policy_factory("expert", TASK)(env)
        for row in result.episodes:
            episode = run_episode(env, expert, row.scenario)
            assert (row.success, row.steps, row.steps_to_goal) == (
                episode.success,
                episode.steps,
                episode.steps_to_goal,
            )
            assert row.errors == pytest.approx(episode.errors, abs=0.00051)


def test_past_the_goal_the_policy_plays_on_to_the_time_limit_and_settles() -> None:
    result = protocol.evaluate("expert", TASK, episodes=2)
    for row in result.episodes:
        assert row.steps < row.settled.steps == TASKS[TASK].time_limit_steps
        assert row.settled.errors["position_error_mm"] < 0.02
        assert np.hypot(row.settled.x_mm, row.settled.y_mm) == pytest.approx(
            row.settled.errors["lateral_error_mm"], abs=0.002
        )
    assert result.summary.settled.sharpest_95.errors["position_error_mm"] is not None


def test_playing_on_changes_no_scenario() -> None:
    with hvs_suite.load("align-hard", split="test") as env:
        first = env.reset(scenario=5).observation
        env.goal_ends_episode = False
        again = env.reset(scenario=5).observation
    for name, value in first.items():
        np.testing.assert_array_equal(value, again[name])


def test_the_action_log_holds_every_action(tmp_path: Path) -> None:
    path = tmp_path / "expert.json"
    result = protocol.evaluate("expert", TASK, path, episodes=2)
    log = action_log.load(result_file.actions_path(path), result.metadata.actions_sha256)
    assert [len(actions) for actions in log] == [row.settled.steps for row in result.episodes]
    assert sorted(file.name for file in tmp_path.iterdir()) == ["expert.actions.npz", "expert.json"]


@pytest.mark.parametrize(
    ("actions", "arrays"),
    [
        (np.random.default_rng(0).uniform(-2.0, 2.0, (50, 7)), {"steps", "actions"}),
        (np.random.default_rng(0).integers(-(2**21), 2**21, (50, 7)) / 2**20, {"steps", "changes"}),
        (np.zeros((50, 7)), {"steps", "changes"}),
        (np.full((50, 7), -0.0), {"steps", "actions"}),
        (np.full((50, 7), 3e8), {"steps", "actions"}),
    ],
    ids=["any", "on a grid", "zeros", "negative zeros", "large"],
)
def test_an_action_log_gives_back_what_it_was_given(
    actions: npt.NDArray[np.float64], arrays: set[str], tmp_path: Path
) -> None:
    given = np.split(actions.astype(np.float32), [20, 20, 49])
    path = tmp_path / "result.actions.npz"
    path.write_bytes(action_log.encode(given))
    with np.load(path) as file:
        assert set(file.files) == arrays
    found = action_log.load(path, action_log.digest(path))
    assert [episode.tobytes() for episode in found] == [episode.tobytes() for episode in given]


def rows(path: Path) -> tuple[str, Any, bytes]:
    text = path.read_text()
    content = json.loads(text)
    del content["metadata"]["created"]
    log = result_file.actions_path(path).read_bytes()
    return text[text.index('"episodes"') :], content["metadata"], log


def test_a_killed_evaluation_goes_on_to_the_same_result(tmp_path: Path) -> None:
    whole, killed = tmp_path / "whole.json", tmp_path / "killed.json"
    protocol.evaluate("random", TASK, whole, episodes=40)
    words = f"evaluate --policy random --task {TASK} --episodes 40 --out {killed}".split()
    process = subprocess.Popen(
        [sys.executable, "-c", "from hvs_suite.cli.main import main; main()", *words]
    )
    partial = tmp_path / "killed.json.partial"
    deadline = time.monotonic() + 60.0
    while not (partial.exists() and partial.read_bytes().count(b"\n") > 4):
        assert process.poll() is None
        assert time.monotonic() < deadline
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    assert not killed.exists()
    with partial.open("ab") as file:
        file.write(b'{"row": {"scen')
    played: list[int] = []
    protocol.evaluate(
        "random", TASK, killed, episodes=40, progress=lambda t: played.append(t.row.scenario)
    )
    assert sorted(played) == list(range(40))
    assert rows(killed) == rows(whole)
    assert not partial.exists()


def test_the_beginning_of_another_evaluation_is_not_mixed_in(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "out.json"
    partial = interrupted(path, "random", 2)
    with pytest.raises(OutputError, match=r"another evaluation \(policy differs\)"):
        protocol.evaluate("zero", TASK, path, episodes=2)
    # Killed before anything was played: nothing is lost by starting anew.
    head = partial.read_bytes().splitlines(keepends=True)[0]
    partial.write_bytes(head)
    protocol.evaluate("zero", TASK, path, episodes=1)
    assert not partial.exists()
    partial.write_text("nonsense\n")
    with pytest.raises(OutputError, match="damaged"):
        protocol.evaluate("zero", TASK, path, episodes=2)
    partial.unlink()
    os.mkfifo(partial)
    with pytest.raises(OutputError, match="no regular file"):
        protocol.evaluate("zero", TASK, path, episodes=2)


def test_a_second_evaluation_into_one_file_is_refused_and_the_first_goes_on(
    tmp_path: Path,
) -> None:
    path = tmp_path / "out.json"
    refusals: list[str] = []

    def start_another(trial: Any) -> None:
        with pytest.raises(OutputError, match="another process is writing") as refusal:
            protocol.evaluate("zero", TASK, path, episodes=2)
        refusals.append(str(refusal.value))

    first = protocol.evaluate("zero", TASK, path, episodes=2, progress=start_another)
    assert len(refusals) == 2
    assert result_file.load(path).episodes == first.episodes


@pytest.mark.parametrize("room", ["nothing", "half the trials", "all but the result"])
def test_on_a_full_disk_nothing_is_lost(
    room: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    whole, full = tmp_path / "whole.json", tmp_path / "full.json"
    protocol.evaluate("random", TASK, whole, episodes=4)
    size = interrupted(tmp_path / "size.json", "random", 4).stat().st_size
    n_bytes = {
        "nothing": 0,
        "half the trials": 2 * size,
        "all but the result": whole.stat().st_size - 1,
    }[room]
    # The robot goes through a temporary file, which the limit would meet first.
    before = "" if room == "nothing" else "import hvs_suite.cell.kinematics as k; k.kinematics()\n"
    words = f"evaluate --policy random --task {TASK} --episodes 4 --out {full}".split()
    code = (
        f"{before}import resource, sys; from hvs_suite.cli.main import main\n"
        f"resource.setrlimit(resource.RLIMIT_FSIZE, ({n_bytes}, {n_bytes})); main(sys.argv[1:])"
    )
    done = subprocess.run([sys.executable, "-c", code, *words], capture_output=True, text=True)
    assert done.returncode == 2, done.stderr
    assert done.stderr.splitlines()[-1].startswith("hvs: cannot write")
    assert "Traceback" not in done.stderr
    assert not full.exists()
    assert main.run(words) == 0
    assert rows(full) == rows(whole)
    assert not list(tmp_path.glob("full*.partial"))
    capsys.readouterr()


def test_several_tasks_write_a_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = "evaluate --policy broken_policies:nan --task align-easy --task align-fixed"
    assert main.run([*words.split(), "--episodes", "1", "--out", str(tmp_path / "mine")]) == 0
    names = {file.name for file in (tmp_path / "mine").iterdir()}
    assert {"align-easy.json", "align-fixed.json"} < names
    assert "scenario 0 lost: NaN" in capsys.readouterr().err
    assert not multiprocessing.active_children()
