"""What a training run loses when its disk is full or its numbers are none: nothing that it had."""

import os
import resource
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import miniature
import numpy as np
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from hvs_suite.cli import main
from hvs_suite.errors import OutputError, TrainingError
from hvs_suite.policies.imitation.frame_cache import cached_frames, new_frames
from hvs_suite.policies.imitation.pretrain import pretrain
from hvs_suite.policies.imitation.state import Counters, load_state, save_state
from hvs_suite.policies.imitation.teacher import Teacher
from hvs_suite.policies.training import run_folder
from hvs_suite.policies.training.curves import Curves

RUN = {
    "steps": 6, "batch_size": 8, "windows": 4, "window_steps": 4, "seed": 3,
    "checkpoint_period_s": 0.0,
}  # fmt: skip
WORDS = "pretrain --data {data} --out {out} --steps 6 --seed 3"


@pytest.fixture
def room() -> Iterator[None]:
    """Takes back what a test allows a file to grow to; Python ignores the signal itself."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, before)


def allow(size: int) -> None:
    """From now on no file may grow beyond a size (bytes), as if its disk were full."""
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)[1]
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit if size < 0 else size, limit))


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    """A small disk of its own, which only root can make."""
    place = tmp_path / "disk"
    place.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=64m", "none", str(place)]
    if os.geteuid() != 0 or subprocess.run(mount, check=False, capture_output=True).returncode:
        pytest.skip("only root can mount a small disk")
    yield place
    subprocess.run(["umount", "-l", str(place)], check=True)


def resize(disk: Path, size: str) -> None:
    subprocess.run(["mount", "-o", f"remount,size={size}", str(disk)], check=True)


@pytest.fixture(scope="module")
def whole(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """Weights of a run that nothing disturbed."""
    out = tmp_path_factory.mktemp("whole") / "run"
    pretrain(dataset, out, **RUN)
    return (out / "model.safetensors").read_bytes()


class Killed(BaseException):
    """What a kill looks like to the loop."""


def kill_after(step):
    def on_progress(progress):
        if progress.step == step:
            raise Killed

    return on_progress


# The decoded frames of a camera take 94 kB, the weights 2 MB before they are halved, the run's
# state 6 MB.
@pytest.mark.usefixtures("room")
@pytest.mark.parametrize("begun", [False, True])
@pytest.mark.parametrize("size", [0, 50_000, 2_000_000])
def test_a_run_that_cannot_write_goes_on_when_it_can(dataset, tmp_path, whole, size, begun):
    out = tmp_path / "run"
    if begun:
        with pytest.raises(Killed):
            pretrain(dataset, out, on_progress=kill_after(3), **RUN)
    kept = (out / "model.safetensors").read_bytes() if begun else None
    allow(size)
    with pytest.raises(OutputError) as refusal:
        pretrain(dataset, out, **RUN)
    allow(-1)
    assert len(str(refusal.value).splitlines()) == 1
    if begun:
        assert (out / "model.safetensors").read_bytes() == kept
    steps = []
    pretrain(dataset, out, on_progress=lambda p: steps.append(p.step), **RUN)
    assert (out / "model.safetensors").read_bytes() == whole
    assert steps[-1] == 6
    assert not begun or 3 not in steps


@pytest.mark.parametrize("size", ["8k", "120k", "250k", "4m"])
def test_a_full_disk_ends_a_run_in_one_line_and_loses_nothing(dataset, disk, whole, size, capfd):
    resize(disk, size)
    out = disk / "run"
    with pytest.raises(OutputError):
        pretrain(dataset, out, **RUN)
    assert "Traceback" not in capfd.readouterr().err
    resize(disk, "64m")
    pretrain(dataset, out, **RUN)
    assert (out / "model.safetensors").read_bytes() == whole


def test_the_command_says_that_the_disk_is_full(dataset, disk, capfd):
    resize(disk, "250k")
    words = WORDS.format(data=dataset, out=disk / "run").split()
    assert main.run(words) == 2
    lines = capfd.readouterr().err.splitlines()
    [line] = [line for line in lines if line.startswith("hvs:")]
    assert "No space left on device" in line
    assert not any("Traceback" in other or "Exception" in other for other in lines)


@pytest.mark.usefixtures("room")
def test_no_file_of_frames_is_mapped_that_has_no_room(tmp_path):
    allow(50_000)
    with pytest.raises(OutputError, match=r"takes 0\.1 MB"):
        new_frames(tmp_path / "frames.npy", (10, 100, 100, 1))
    assert not list(tmp_path.iterdir())
    frames = new_frames(tmp_path / "frames.npy", (4, 100, 100, 1))
    assert (frames.shape, frames.dtype, int(frames.sum())) == ((4, 100, 100, 1), np.uint8, 0)


@pytest.mark.usefixtures("room")
def test_curves_notice_a_full_disk_at_once(tmp_path):
    curves = Curves(tmp_path, 0)
    allow(1000)
    with pytest.raises(OutputError):
        curves.add({"x" * 2000: 1.0}, 0)
    allow(-1)
    curves.close()


def test_curves_are_cut_where_a_sitting_was_lost(tmp_path):
    for first, value in ((0, 1.0), (3, 2.0)):
        curves = Curves(tmp_path, first)
        for step in range(first, 5):
            curves.add({"loss": value}, step)
        curves.close()
    events = EventAccumulator(str(tmp_path))
    events.Reload()
    found = [(event.step, event.value) for event in events.Scalars("loss")]
    assert found == [(0, 1.0), (1, 1.0), (2, 1.0), (3, 2.0), (4, 2.0)]


@pytest.mark.parametrize("key", ["action", "observation.state", "privileged.target_eth"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_dataset_with_numbers_that_are_none_is_refused(tmp_path, capsys, key, value):
    columns = miniature.scene(40)
    columns[key][17, 1] = value
    miniature.write_dataset(tmp_path / "data", columns, miniature.episodes(40))
    words = WORDS.format(data=tmp_path / "data", out=tmp_path / "run").split()
    assert main.run(words) == 2
    line = [each for each in capsys.readouterr().err.splitlines() if each.startswith("hvs:")]
    assert len(line) == 1
    assert f"{key} holds NaN or infinity in 1 rows, row 17 first" in line[0]
    assert not (tmp_path / "run" / "model.safetensors").exists()


@pytest.mark.parametrize("where", ["loss", "gradient"])
def test_a_run_that_comes_apart_keeps_its_last_good_weights(dataset, tmp_path, monkeypatch, where):
    out = tmp_path / "run"
    with pytest.raises(Killed):
        pretrain(dataset, out, on_progress=kill_after(2), **RUN)
    shutil.copytree(out, tmp_path / "before")
    sound = Teacher.lesson

    def unsound(self, rows, step):
        loss, parts = sound(self, rows, step)
        lead = self.policy.network.lead_s
        # The root of 0 is 0, and its slope is infinite.
        return loss * np.nan if where == "loss" else (lead - lead.detach()).sqrt(), parts

    monkeypatch.setattr(Teacher, "lesson", unsound)
    with pytest.raises(TrainingError, match="came apart at step 3"):
        pretrain(dataset, out, **RUN)
    for name in ("model.safetensors", "training/state.safetensors"):
        assert (out / name).read_bytes() == (tmp_path / "before" / name).read_bytes()


@pytest.mark.parametrize(
    "content", ["", "null", "[" * 100_000, "{}", '{"settings": null}', '{"settings": [1]}']
)
def test_a_run_whose_settings_are_damaged_is_left_alone(tmp_path, content):
    (tmp_path / run_folder.CONFIG).write_text(content)
    with pytest.raises(OutputError) as refusal, run_folder.claimed(tmp_path, {"seed": 3}):
        pytest.fail("it was claimed")
    assert len(str(refusal.value).splitlines()) == 1
    assert (tmp_path / run_folder.CONFIG).read_text() == content


def pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


SPOILT = {
    "empty": lambda path: path.write_bytes(b""),
    "cut": lambda path: os.truncate(path, path.stat().st_size // 2),
    "another": lambda path: np.save(path.open("wb"), np.zeros(3, np.uint8)),
    "deep": lambda path: path.write_bytes(b"[" * 100_000),
    "pipe": pipe,
}


@pytest.mark.timeout(60)
@pytest.mark.parametrize("spoil", SPOILT.values(), ids=SPOILT)
def test_frames_that_were_spoilt_are_decoded_anew(dataset, tmp_path, spoil):
    shape, n = (28, 28, 3), 40
    camera = "observation.images.eih"
    frames = np.array(cached_frames(dataset, camera, shape, n, tmp_path))
    for path in (tmp_path / f"{camera}.npy", tmp_path / f"{camera}.json"):
        spoil(path)
        again = cached_frames(dataset, camera, shape, n, tmp_path)
        np.testing.assert_array_equal(again, frames)
        path.unlink()
        path.mkdir()
        with pytest.raises(OutputError, match="cannot"):
            cached_frames(dataset, camera, shape, n, tmp_path)
        path.rmdir()
        cached_frames(dataset, camera, shape, n, tmp_path)


@pytest.mark.timeout(60)
@pytest.mark.parametrize("spoil", SPOILT.values(), ids=SPOILT)
def test_a_state_that_was_spoilt_is_not_resumed(tmp_path, spoil):
    layer = torch.nn.Linear(1, 1)
    optimizer = torch.optim.AdamW(layer.parameters())
    path = tmp_path / "state.safetensors"
    save_state(path, layer, optimizer, Counters())
    spoil(path)
    with pytest.raises(OutputError) as refusal:
        load_state(path, layer, optimizer)
    assert len(str(refusal.value).splitlines()) == 1
