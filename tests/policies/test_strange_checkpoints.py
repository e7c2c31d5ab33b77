"""Checkpoints that strangers made: nothing in them runs, and what is damaged is refused in a line.

None of these tests imports LeRobot: everything is found before LeRobot would be asked.
"""

import contextlib
import dataclasses
import json
import os
import pickle
import resource
import shutil
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import huggingface_hub.constants
import numpy as np
import pytest
import torch
from safetensors.numpy import load_file, save_file

from hvs_suite.cli import main
from hvs_suite.errors import HvsError, PolicyError
from hvs_suite.eval.scoring import action_log, contender
from hvs_suite.eval.scoring.provenance import file_hash
from hvs_suite.policies import imported
from hvs_suite.policies.catalogue import checkpoint_folder, policy_factory
from hvs_suite.policies.checkpoints.files import read_config, read_shapes
from hvs_suite.policies.imitation import dagger
from hvs_suite.policies.imitation.frame_cache import open_frames
from hvs_suite.policies.imitation.state import load_state
from hvs_suite.registry import TASKS

TASK = "align-easy"
COMMIT = "0123456789abcdef0123456789abcdef01234567"
SUMMARY_FIELDS = [field.name for field in dataclasses.fields(dagger.RoundSummary)]
Damage = Callable[[Path], object]


@pytest.fixture
def strange(tmp_path: Path) -> Path:
    """A copy of the shipped weights, to be spoilt."""
    folder = tmp_path / "strange"
    shutil.copytree(checkpoint_folder("pretrained", TASK), folder)
    return folder


@pytest.fixture
def bounded_memory() -> Iterator[None]:
    """Room for 4 GB more than there is: whoever takes more without asking is found out."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + 2**32, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_AS, before)


def change(path: Path, edit: Callable[[Any], object]) -> None:
    content = json.loads(path.read_text())
    edit(content)
    path.write_text(json.dumps(content))


def with_step(folder: Path, processor: str, step: dict[str, Any]) -> None:
    change(folder / f"policy_{processor}.json", lambda content: content["steps"].append(step))


def payloads(marker: Path) -> dict[str, dict[str, Any]]:
    """Steps that would make a file, or run unchecked code."""
    return {
        "Popen": {"class": "subprocess.Popen", "config": {"args": ["touch", str(marker)]}},
        "system": {"class": "os.system", "config": {"command": f"touch {marker}"}},
        "exec": {"class": "builtins.exec", "config": {"source": f"open({str(marker)!r}, 'w')"}},
        "unregistered": {"class": "hvs_suite.policies.builtin.ZeroPolicy", "config": {}},
        "both": {
            "registry_name": "device_processor",
            "class": "os.system",
            "config": {"command": f"touch {marker}"},
        },
        "remote code": {
            "registry_name": "action_tokenizer_processor",
            "config": {"action_tokenizer_name": str(marker.parent), "trust_remote_code": True},
        },
        "unknown": {"registry_name": "no_such_processor"},
    }


DOORS = {
    "evaluate": "evaluate --policy {policy} --task align-easy --episodes 1 --out {out}/r.json",
    "view": "view align-easy --policy {policy} --out {out}/film.gif",
    "serve": "serve --policy {policy} --port 0",
    "finetune": "finetune --policy {policy} --task align-easy --out {out}/run --steps 1",
    "study": "study attention --policy {policy} --task align-easy --out {out}/eyes.png",
}


def refused(words: str, capsys: pytest.CaptureFixture[str]) -> str:
    """The one line with which a command is refused."""
    assert main.run(words.split()) == 2
    [line] = capsys.readouterr().err.splitlines()
    return str(line)


@pytest.mark.parametrize("processor", ["preprocessor", "postprocessor"])
@pytest.mark.parametrize("payload", payloads(Path("marker")))
def test_no_step_of_a_stranger_runs(
    strange: Path, tmp_path: Path, processor: str, payload: str, capsys: pytest.CaptureFixture[str]
) -> None:
    marker = tmp_path / "marker"
    with_step(strange, processor, payloads(marker)[payload])
    line = refused(DOORS["evaluate"].format(policy=strange, out=tmp_path), capsys)
    assert f"policy_{processor}.json: steps." in line
    assert not marker.exists()


@pytest.mark.parametrize("door", DOORS)
@pytest.mark.parametrize("is_fetched", [False, True])
def test_every_door_refuses_a_step_that_names_code(
    strange: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    door: str,
    is_fetched: bool,
) -> None:
    marker = tmp_path / "marker"
    with_step(strange, "preprocessor", payloads(marker)["Popen"])
    policy = str(strange)
    if is_fetched:
        policy = fetched(strange, tmp_path / "cache", monkeypatch)
    line = refused(DOORS[door].format(policy=policy, out=tmp_path), capsys)
    assert "'class' names code to import ('subprocess.Popen')" in line
    assert not marker.exists()


def test_nobody_passes_such_a_checkpoint_on(
    strange: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with_step(strange, "preprocessor", payloads(tmp_path / "marker")["Popen"])
    assert "names code" in refused(f"ship {strange} --to-folder {tmp_path}/shipped", capsys)
    assert not (tmp_path / "shipped").exists()


def test_eyes_are_not_taken_from_such_a_checkpoint(strange: Path, tmp_path: Path) -> None:
    from hvs_suite.policies.checkpoints.loading import weights_digest

    with_step(strange, "preprocessor", payloads(tmp_path / "marker")["Popen"])
    # The first thing that pretraining asks of the folder.
    with pytest.raises(PolicyError, match="names code"):
        weights_digest(strange)


def fetched(folder: Path, cache: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """The Hub id of a folder, laid into a cache as the Hub's client does it: links to contents."""
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_CACHE", str(cache))
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_OFFLINE", True)
    kept = cache / "models--someone--servoing"
    snapshot = kept / "snapshots" / COMMIT
    for part in (snapshot, kept / "refs", kept / "blobs"):
        part.mkdir(parents=True)
    (kept / "refs" / "main").write_text(COMMIT)
    for number, path in enumerate(sorted(folder.glob("*.*"))):
        shutil.copy(path, kept / "blobs" / f"{number:064x}")
        (snapshot / path.name).symlink_to(f"../../blobs/{number:064x}")
    return "someone/servoing"


def test_a_sound_checkpoint_of_the_hub_is_taken_through_its_links(
    strange: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spec = fetched(strange, tmp_path / "cache", monkeypatch)
    policy_factory(spec, TASK)(SimpleNamespace(spec=TASKS[TASK]))


def config(**values: Any) -> Damage:
    return lambda folder: change(folder / "config.json", lambda content: content.update(values))


def feature(value: Any) -> Damage:
    def edit(content: Any) -> None:
        content["input_features"]["observation.images.eih"] = value

    return lambda folder: change(folder / "config.json", edit)


def weights(edit: Callable[[dict[str, Any]], object]) -> Damage:
    def spoil(folder: Path) -> None:
        tensors = load_file(folder / "model.safetensors")
        edit(tensors)
        save_file(tensors, folder / "model.safetensors")

    return spoil


def content(name: str, text: str | bytes) -> Damage:
    written = text.encode() if isinstance(text, str) else text
    return lambda folder: (folder / name).write_bytes(written)


def header(text: str) -> bytes:
    return struct.pack("<Q", len(text)) + text.encode()


def state_file(name: Any) -> Damage:
    step = {"registry_name": "normalizer_processor", "state_file": name}
    return lambda folder: with_step(folder, "preprocessor", step)


def instead(name: str, make: Callable[[Path], object]) -> Damage:
    def spoil(folder: Path) -> None:
        (folder / name).unlink()
        make(folder / name)

    return spoil


def outside(path: Path) -> None:
    """A link to a file beside the checkpoint, not in it."""
    other = path.parent.parent / "elsewhere.json"
    other.write_text("{}")
    path.symlink_to(other)


def sparse(path: Path) -> None:
    with path.open("wb") as file:
        file.truncate(2**40)


EIH = "observation.images.eih"
DAMAGES: dict[str, Damage] = {
    **{
        f"{name} {label}": content(name, text)
        for name in ("config.json", "policy_preprocessor.json", "policy_postprocessor.json")
        for label, text in {
            "empty": "",
            "null": "null",
            "list": "[]",
            "string": '"text"',
            "number": "3",
            "NaN": '{"type": NaN}',
            "deep": "[" * 100_000,
            "no UTF-8": b"\xff\xfe\xff",
            "without content": "{}",
        }.items()
    },
    **{
        f"{name} as {label}": instead(name, make)
        for name in ("config.json", "policy_preprocessor.json", "model.safetensors")
        for label, make in {
            "FIFO": os.mkfifo,
            "folder": Path.mkdir,
            "device": lambda path: path.symlink_to("/dev/zero"),
            "link out": outside,
            "loop": lambda path: path.symlink_to(path),
            "a terabyte": sparse,
        }.items()
    },
    "another file a FIFO": lambda folder: os.mkfifo(folder / "extra.safetensors"),
    **{
        f"{key} {value!r:.40}": config(**{key: value})
        for key, values in {
            "type": [None, 3, ["hvs"], "pi0", "gaussian_actor", "x" * 1000],
            "input_features": [None, [], {}, "eih", 3],
            "output_features": [None, [], {}],
            "channels": [None, "32", [32], 0, -1, 1.5, True, 2**40, 10**400, 4096],
            "hidden": [None, 2**31, 4096],
            "error_scale": [None, "small", 0, -1.0],
            "residual_hidden": [None, -3, 2**40, 64],
            "slopes": [None, ["top"], ["eih"]],
            "slopes_by": [None, "size", ["colour"]],
            "offsets": [None, ["top"], ["eth"], ["eth", "eth"]],
        }.items()
        for value in values
    },
    **{
        f"feature {value!r:.60}": feature(value)
        for value in [
            None,
            [],
            "VISUAL",
            {"type": "VISUAL"},
            {"type": None, "shape": [3, 112, 112]},
            *(
                {"type": "VISUAL", "shape": shape}
                for shape in (
                    None, "3", [], ["3", 112, 112], [-3, 112, 112], [3, [112], 112], [3.5, 1, 1],
                    [3, 0, 112], [10**30, 112, 112], [3, 112], [3] * 9,
                )
            ),
        ]
    },
    **{
        f"weights {label}": content("model.safetensors", text)
        for label, text in {
            "empty": b"",
            "short": b"\x01",
            "no header": b"\x00" * 8,
            "endless header": b"\xff" * 64,
            "header beyond the file": struct.pack("<Q", 1000) + b"{}",
            "no JSON": header("weights"),
            "no tensors": header("{}"),
            "tensor beyond the file": header(
                '{"a": {"dtype": "F32", "shape": [1000000], "data_offsets": [0, 4000000]}}'
            ),
            "overflow": header(
                '{"a": {"dtype": "F32", "shape": [4294967296, 4294967296, 4], '
                '"data_offsets": [0, 0]}}'
            ),
            "negative shape": header(
                '{"a": {"dtype": "F32", "shape": [-1], "data_offsets": [0, 4]}}'
            ),
        }.items()
    },
    "weights cut short": lambda folder: os.truncate(folder / "model.safetensors", 500_000),
    "a tensor missing": weights(lambda tensors: tensors.popitem()),
    "a tensor too many": weights(lambda tensors: tensors.update(more=np.zeros(3, np.float32))),
    "a tensor of another shape": weights(
        lambda tensors: tensors.update({"network.lead_s": np.zeros(3, np.float32)})
    ),
    **{
        f"state file {name!r}": state_file(name)
        for name in [
            "../model.safetensors", "/etc/passwd", "sub/model.safetensors", "..", "", "config.json",
            "model.bin", "a\0b.safetensors", "missing.safetensors", 3, ["model.safetensors"],
        ]
    },
    "steps a dict": content("policy_preprocessor.json", '{"steps": {}}'),
    "a step null": content("policy_preprocessor.json", '{"steps": [null]}'),
    "arguments a list": content(
        "policy_preprocessor.json",
        '{"steps": [{"registry_name": "device_processor", "config": [1]}]}',
    ),
}  # fmt: skip


@pytest.mark.timeout(20)
@pytest.mark.usefixtures("bounded_memory")
@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_checkpoint_is_refused_in_one_line(strange: Path, damage: str) -> None:
    DAMAGES[damage](strange)
    with pytest.raises(PolicyError) as refusal:
        policy_factory(str(strange), TASK)(SimpleNamespace(spec=TASKS[TASK]))
    assert len(str(refusal.value).splitlines()) == 1
    assert len(str(refusal.value)) < 600


def test_what_was_not_damaged_is_taken(strange: Path) -> None:
    policy_factory(str(strange), TASK)(SimpleNamespace(spec=TASKS[TASK]))
    assert read_config(strange)["type"] == "hvs"


@pytest.mark.parametrize(
    "outcome",
    [
        "",
        "[]",
        "{}",
        '{"step": -1, "train_s": 1.0}',
        '{"step": 1, "train_s": -1.0}',
        '{"step": 1, "train_s": NaN}',
        '{"step": NaN, "train_s": 1.0}',
        '{"step": 1, "train_s": 1e999}',
        '{"step": "many", "train_s": 1.0}',
        '{"step": null, "train_s": null}',
        '{"step": 1%s, "train_s": 1.0}' % ("0" * 400),
    ],
)
def test_notes_that_a_result_could_not_hold_are_refused_before_anything_is_played(
    strange: Path, outcome: str
) -> None:
    (strange / "training" / "outcome.json").write_text(outcome)
    with pytest.raises(PolicyError, match="mend or remove") as refusal:
        contender.find(str(strange), TASK)
    assert len(str(refusal.value).splitlines()) == 1


def test_notes_without_a_held_out_loss_are_taken(strange: Path) -> None:
    (strange / "training" / "outcome.json").write_text(
        '{"step": 7, "train_s": 1800.0, "held_out_loss": NaN}'
    )
    found = contender.find(str(strange), TASK)
    assert (found.training_steps, found.training_hours) == (7, 0.5)
    assert found.parameters == read_total(strange)


def read_total(folder: Path) -> int:
    return sum(value.size for value in load_file(folder / "model.safetensors").values())


class Payload:
    """Makes a file when it is unpickled."""

    def __init__(self, marker: Path) -> None:
        self._marker = marker

    def __reduce__(self) -> tuple[Any, ...]:
        return (Path.touch, (self._marker,))


def load_training_state(path: Path) -> None:
    layer = torch.nn.Linear(1, 1)
    load_state(path, layer, torch.optim.AdamW(layer.parameters()))


def read_shipped(path: Path) -> None:
    for source in checkpoint_folder("pretrained", TASK).glob("*.json"):
        shutil.copy(source, path.parent)
    policy_factory(str(path.parent), TASK)


LOADERS: dict[str, tuple[str, Callable[[Path], object]]] = {
    "weights": ("model.safetensors", read_shipped),
    "actor": ("model.safetensors", lambda path: read_shapes(path.parent)),
    "state of a run": ("state.safetensors", load_training_state),
    "round": (dagger.COLUMNS, lambda path: dagger.read_round(path.parent)),
    "frames": ("frames.npy", open_frames),
    "actions": ("log.actions.npz", lambda path: action_log.load(path, file_hash(path))),
}


@pytest.mark.parametrize("loader", LOADERS)
@pytest.mark.parametrize("form", ["pickle", "torch", "npy", "npz"])
def test_nothing_unpickles(tmp_path: Path, loader: str, form: str) -> None:
    name, load = LOADERS[loader]
    path, marker = tmp_path / name, tmp_path / "marker"
    with path.open("wb") as file:
        if form == "pickle":
            pickle.dump(Payload(marker), file)
        elif form == "torch":
            torch.save({"weight": Payload(marker)}, file)
        elif form == "npy":
            np.save(file, np.array([Payload(marker)], object), allow_pickle=True)
        else:
            np.savez(file, **{f"{n:04d}": np.array([Payload(marker)], object) for n in range(2)})
    (tmp_path / dagger.SUMMARY).write_text(json.dumps(dict.fromkeys(SUMMARY_FIELDS, 0)))
    with contextlib.suppress(HvsError, ValueError):
        load(path)
    assert not marker.exists()
    pickle.loads(pickle.dumps(Payload(marker)))  # noqa: S301 - the payload does work
    assert marker.exists()


SAC = {
    "type": "hvs_sac",
    "format": 1,
    "task": TASK,
    "action_mode": "joint_position",
    "inputs": {"eih": {"shape": [3, 112, 112]}, "joint_positions": {"high": [3.0] * 7}},
    "hidden": [16, 16],
}


@pytest.mark.timeout(20)
@pytest.mark.usefixtures("bounded_memory")
@pytest.mark.parametrize(
    "values",
    [
        {},
        {"inputs": None},
        {"inputs": {}},
        {"inputs": {"eih": None}},
        {"inputs": {"eih": {"shape": None}}},
        {"inputs": {"eih": {"high": [1.0] * 7}}},
        {"inputs": {"joint_positions": {"shape": [3, 112, 112]}}},
        {"inputs": {"joint_positions": {"high": "far"}}},
        {"inputs": {"joint_positions": {"high": [-1.0] * 7}}},
        {"eyes": "crossed"},
        {"eyes": "pretrained"},
        {"eyes": "pretrained", "eye_channels": 2**40},
        {"eye_channels": 32},
        {
            "eyes": "shared",
            "inputs": {n: {"shape": [c, 16, 16]} for n, c in (("eih", 3), ("eth", 1))},
        },
        {"hidden": None},
        {"hidden": ["16"]},
        {"hidden": [0]},
        {"hidden": [2**40]},
        {"hidden": [4096] * 16},
        {"action_mode": None},
        {"action_mode": ["joint_position"]},
    ],
)
def test_a_damaged_actor_is_refused_in_one_line(tmp_path: Path, values: dict[str, Any]) -> None:
    (tmp_path / "config.json").write_text(json.dumps({**SAC, **values}))
    save_file({"mu.bias": np.zeros(7, np.float32)}, tmp_path / "model.safetensors")
    with pytest.raises(PolicyError) as refusal:
        policy_factory(str(tmp_path), TASK)(SimpleNamespace(spec=TASKS[TASK]))
    assert len(str(refusal.value).splitlines()) == 1


OWN_CODE = """
class Mute(Exception):
    def __str__(self):
        raise RuntimeError("not even that")

def needs_more(context, weights):
    ...

def mute(context):
    raise Mute

def leaves(context):
    return None
"""


@pytest.mark.parametrize(
    ("name", "said"), [("needs_more", "weights"), ("mute", "Mute"), ("leaves", "reset()")]
)
def test_a_factory_that_fails_is_named_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, said: str
) -> None:
    (tmp_path / f"own_{name}.py").write_text(OWN_CODE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.path", [*__import__("sys").path])
    monkeypatch.setattr(imported.PolicyContext, "of", lambda env: env)
    make = policy_factory(f"own_{name}:{name}", TASK)
    with pytest.raises(PolicyError, match=said.replace("(", r"\(").replace(")", r"\)")) as refusal:
        make(SimpleNamespace(spec=TASKS[TASK]))
    assert len(str(refusal.value).splitlines()) == 1


@pytest.mark.parametrize(
    "body", ["raise SystemExit(0)", OWN_CODE.replace("def needs", "raise Mute\ndef needs")]
)
def test_a_module_that_fails_is_named_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, body: str, request: pytest.FixtureRequest
) -> None:
    name = f"failing_{abs(hash(request.node.name))}"
    (tmp_path / f"{name}.py").write_text(body)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.path", [*__import__("sys").path])
    monkeypatch.setattr(imported.PolicyContext, "of", lambda env: env)
    make = policy_factory(f"{name}:make", TASK)
    with pytest.raises(PolicyError, match=f"cannot import {name}"):
        make(SimpleNamespace(spec=TASKS[TASK]))
