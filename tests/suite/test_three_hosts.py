"""What one process does, three hosts do: the same rows, frames and weights, whoever dies meanwhile.

The two that play have no file of the head's: what they need has to travel.
"""

import contextlib
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from hosts import Hosts, reason_against
from safetensors.numpy import load_file

from hvs_suite.datasets.recorder import record
from hvs_suite.eval import protocol
from hvs_suite.eval.scoring import progress_file, result_file
from hvs_suite.policies.catalogue import checkpoint_folder
from hvs_suite.policies.imitation.pretrain import pretrain

TASK = "align-thesis"
SAMPLE = Path(__file__).parents[2] / "datasets" / "samples" / TASK
HVS = Path(sys.executable).with_name("hvs")
pytestmark = pytest.mark.timeout(600)


@pytest.fixture(scope="module")
def hosts() -> Iterator[Hosts]:
    """A head and two others, all of one cluster."""
    pytest.importorskip("ray")
    if reason := reason_against():
        pytest.skip(reason)
    with Hosts() as made:
        made.start("one", "two")
        yield made


def command(hosts: Hosts, words: list[str]) -> subprocess.Popen[str]:
    """Run ``hvs`` on the head, to play on the others."""
    words = [str(HVS), *words, "--ray", hosts.address]
    return hosts.popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)


def finish(process: subprocess.Popen[str]) -> None:
    _, complaint = process.communicate()
    assert process.returncode == 0, complaint


def wait_for_trials(process: subprocess.Popen[str], partial: Path, count: int) -> None:
    """Wait until an evaluation has kept so many trials."""
    while process.poll() is None:
        with contextlib.suppress(FileNotFoundError):
            if partial.read_bytes().count(b"\n") > count:
                return
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(0.05)
    raise AssertionError(f"ended before {count} trials were kept: {process.communicate()[1]}")


def assert_same_weights(one: Path, other: Path) -> None:
    weights, others = (load_file(folder / "model.safetensors") for folder in (one, other))
    for name, value in weights.items():
        np.testing.assert_array_equal(value, others[name], err_msg=name)


@pytest.mark.slow
def test_an_evaluation_survives_the_death_of_its_driver_and_of_a_host(
    hosts: Hosts, tmp_path: Path
) -> None:
    policy = tmp_path / "policy"
    shutil.copytree(checkpoint_folder("pretrained", TASK), policy)
    out, partial = tmp_path / "there.json", tmp_path / f"there.json{progress_file.SUFFIX}"
    words = ["evaluate", "--policy", str(policy), "--task", TASK, "--out", str(out)]
    words += ["--episodes", "30"]
    first = command(hosts, words)
    wait_for_trials(first, partial, 4)
    first.send_signal(signal.SIGKILL)
    first.wait()
    kept = partial.read_bytes().count(b"\n")
    assert not out.exists()
    again = command(hosts, words)
    wait_for_trials(again, partial, kept + 4)
    hosts.kill("two")
    finish(again)
    here = protocol.evaluate(str(policy), TASK, tmp_path / "here.json", episodes=30)
    there = result_file.load(out)
    assert there.episodes == here.episodes
    logs = [result_file.actions_path(tmp_path / name).read_bytes() for name in ("here.json", out)]
    assert logs[0] == logs[1]


@pytest.mark.slow
def test_a_host_that_joins_plays_too(hosts: Hosts) -> None:
    script = f"""
import sys
sys.path.insert(0, {str(Path(__file__).parent)!r})
from test_rollout import Counter, Echo
from hvs_suite.on_ray import RayCluster
from hvs_suite.rollout import play
def place(env, policy, scenario):
    import ray
    return ray.util.get_node_ip_address()
seen = set()
for here in play(Counter, Echo, range(10**6), place, workers=RayCluster({hosts.address!r})):
    if here not in seen:
        seen.add(here)
        print(here, flush=True)
    if len(seen) == 2:
        break
"""
    playing = hosts.popen([sys.executable, "-c", script], stdout=subprocess.PIPE)
    assert playing.stdout is not None
    assert playing.stdout.readline().strip() == hosts.address_of["one"]
    hosts.start("two")
    assert playing.stdout.readline().strip() == hosts.address_of["two"]
    assert playing.wait() == 0


@pytest.mark.slow
def test_a_dataset_is_that_of_one_process(hosts: Hosts, tmp_path: Path) -> None:
    words = ["record", "--task", TASK, "--episodes", "6", "--out", str(tmp_path / "there")]
    finish(command(hosts, words))
    record(TASK, 6, "train", tmp_path / "here")
    files = [path for path in (tmp_path / "here").rglob("*") if path.is_file()]
    assert any(path.suffix == ".parquet" for path in files)
    for path in files:
        if path.name != "hvs.json":
            there = tmp_path / "there" / path.relative_to(tmp_path / "here")
            assert path.read_bytes() == there.read_bytes(), path.name


@pytest.mark.slow
def test_dagger_ends_in_the_weights_of_one_process(hosts: Hosts, tmp_path: Path) -> None:
    words = ["pretrain", "--data", str(SAMPLE), "--out", str(tmp_path / "there"), "--steps", "4"]
    words += ["--dagger-rounds", "1", "--dagger-frames", "60"]
    finish(command(hosts, words))
    pretrain(SAMPLE, tmp_path / "here", steps=4, dagger_rounds=1, dagger_frames=60, workers=1)
    assert_same_weights(tmp_path / "here", tmp_path / "there")
