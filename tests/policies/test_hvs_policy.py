"""The `hvs` policy as LeRobot knows it: checkpoints, windows, and playing it without."""

import json
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from hvs_suite.datasets.features import dataset_features
from hvs_suite.errors import PolicyError
from hvs_suite.policies.belief.acting import CompiledBelief, act
from hvs_suite.policies.belief.belief import COVARIANCE, N_MOTION
from hvs_suite.policies.belief.cell_model import cell_model
from hvs_suite.policies.belief.eye import SIGHTING_SIZE
from hvs_suite.policies.belief.network import SET_POINT
from hvs_suite.policies.belief.recorded import set_points
from hvs_suite.policies.belief.settings import as_numbers
from hvs_suite.policies.catalogue import policy_factory
from hvs_suite.policies.checkpoints.files import read_config
from hvs_suite.policies.checkpoints.loading import CheckpointPolicy, load_network
from hvs_suite.policies.trained_for import trained_for
from hvs_suite.policies.training.dataset import read_columns, read_manifest
from hvs_suite.registry import TASKS

SAMPLE = Path(__file__).parents[2] / "datasets" / "samples" / "align-thesis"
# Cameras and joints alone; a goal to choose; a target that moves; a wrench and a tool.
PLAYED = ("align-easy", "clutter-choice", "track-line", "insert-wide")
WINDOW = 5
ENDS = (1, 11, 22)
"""Of the windows of the batch: the second frame of an episode, and two that show the target."""


def new_policy(task: str):
    """An untrained policy for a task, with its gates opened at random."""
    from lerobot.configs import FeatureType
    from lerobot.utils.feature_utils import dataset_to_policy_features

    from hvs_suite.policies.hvs import HvsConfig, HvsPolicy

    spec = TASKS[task]
    features = dataset_to_policy_features(dataset_features(spec))
    config = HvsConfig(
        input_features={k: f for k, f in features.items() if f.type is not FeatureType.ACTION},
        output_features={k: f for k, f in features.items() if f.type is FeatureType.ACTION},
        cell=as_numbers(cell_model(spec)),
        channels=8,
        hidden=32,
        foresight=3 if spec.family == "track" else 0,
        device="cpu",
        **trained_for(spec).model_dump(),
    )
    torch.manual_seed(0)
    policy = HvsPolicy(config).eval()
    with torch.no_grad():
        for parameter in policy.parameters():
            parameter.add_(0.02 * torch.randn_like(parameter))
    return policy


@pytest.fixture(scope="module", params=PLAYED)
def played(request, tmp_path_factory):
    """A task, a policy for it, and its checkpoint."""
    from hvs_suite.policies.hvs.modeling_hvs import HvsPolicy, save_checkpoint

    folder = tmp_path_factory.mktemp(request.param)
    save_checkpoint(new_policy(request.param), folder)
    return TASKS[request.param], HvsPolicy.from_pretrained(folder), folder


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    from hvs_suite.policies.hvs.modeling_hvs import save_checkpoint

    folder = tmp_path_factory.mktemp("belief")
    save_checkpoint(new_policy("align-easy"), folder)
    return folder


def observations(spec, n: int) -> list[dict]:
    """What an environment of the task might show, whatever it means."""
    random = np.random.default_rng(0)
    bent = np.array([0.0, 0.6, 0.0, -1.4, 0.0, 1.1, 0.0])
    shown = []
    for _ in range(n):
        seen = {
            name: random.integers(0, 256, (side, side, 3), dtype=np.uint8)
            for name, side in (("eih", spec.eih_resolution), ("eth", spec.eth_resolution))
        }
        seen["joint_positions"] = bent + random.uniform(-0.2, 0.2, 7)
        seen["joint_velocities"] = random.uniform(-0.5, 0.5, 7)
        for name, vector in spec.further_observations.items():
            seen[name] = random.uniform(0.0, 1.0, len(vector.dimensions))
        shown.append(seen)
    return shown


def as_lerobot(spec, observation: dict) -> dict[str, torch.Tensor]:
    """The same as LeRobot hands it to a policy's pre-processor."""
    joints = [observation["joint_positions"], observation["joint_velocities"]]
    batch = {"observation.state": torch.from_numpy(np.concatenate(joints)).float()}
    for name in ("eih", "eth"):
        image = torch.from_numpy(observation[name]).permute(2, 0, 1) / 255.0
        batch[f"observation.images.{name}"] = image
    for name in spec.further_observations:
        batch[f"observation.{name}"] = torch.from_numpy(observation[name]).float()
    return batch


def one(spec, observation: dict, n: int = 1) -> dict[str, torch.Tensor]:
    """A batch of n alike."""
    batch = as_lerobot(spec, observation)
    return {key: value[None].repeat(n, *[1] * value.dim()) for key, value in batch.items()}


# --- as LeRobot keeps it ---


def test_importing_the_package_registers_the_type():
    ask = (
        "import hvs_suite.policies.hvs\n"
        "from lerobot.configs import PreTrainedConfig\n"
        "print(PreTrainedConfig.get_choice_class('hvs').__name__)"
    )
    done = subprocess.run([sys.executable, "-c", ask], capture_output=True, text=True, check=True)
    assert done.stdout == "HvsConfig\n"


def test_the_network_needs_no_lerobot(tmp_path: Path):
    code = (
        "import sys; import hvs_suite.policies.checkpoints.loading, hvs_suite.policies.catalogue;"
        "sys.exit(any(m.split('.')[0] in ('lerobot', 'datasets') for m in sys.modules))"
    )
    assert subprocess.run([sys.executable, "-c", code], cwd=tmp_path).returncode == 0


def test_a_saved_policy_is_the_same_policy(played):
    from lerobot.configs import PreTrainedConfig
    from lerobot.policies.factory import get_policy_class

    spec, policy, folder = played
    config = PreTrainedConfig.from_pretrained(folder)
    assert config.cell == as_numbers(cell_model(spec))
    again = get_policy_class(config.type).from_pretrained(folder, config=config)
    assert again.network.belief.prior.dtype == torch.float64
    policy.reset()
    for observation in observations(spec, 3):
        batch = one(spec, observation)
        torch.testing.assert_close(
            again.select_action(batch), policy.select_action(batch), atol=0, rtol=0
        )


def test_weights_are_kept_in_half_precision(played, tmp_path):
    from hvs_suite.policies.hvs.modeling_hvs import HvsPolicy, save_checkpoint

    spec, policy, folder = played
    size = (folder / "model.safetensors").stat().st_size
    assert size < 2.2 * sum(weight.numel() for weight in policy.parameters())
    with torch.random.fork_rng():
        torch.manual_seed(0)
        fresh = new_policy(spec.name)
    save_checkpoint(fresh, tmp_path)
    kept = HvsPolicy.from_pretrained(tmp_path)
    for mine, theirs in zip(kept.parameters(), fresh.parameters(), strict=True):
        assert mine.dtype == theirs.dtype
        torch.testing.assert_close(mine, theirs, rtol=1e-3, atol=1e-7)


def test_whoever_may_read_a_new_file_may_read_a_checkpoint(played, tmp_path):
    _, _, folder = played
    (tmp_path / "new").touch()
    modes = {path.stat().st_mode for path in folder.iterdir() if path.is_file()}
    assert modes == {(tmp_path / "new").stat().st_mode}


def test_goal_and_wrench_are_named_in_the_configuration(played):
    spec, policy, _ = played
    named = [policy.config.goal_key, policy.config.wrench_key]
    further = [f"observation.{name}" for name in spec.further_observations]
    assert [key for key in named if key is not None] == further


def test_the_player_without_lerobot_acts_like_lerobot_over_an_episode(played):
    from lerobot.policies.factory import make_pre_post_processors

    spec, policy, folder = played
    before, after = make_pre_post_processors(policy.config, pretrained_path=str(folder))
    player = CheckpointPolicy(folder, spec)
    for _ in range(2):
        policy.reset()
        player.reset()
        for observation in observations(spec, 6):
            theirs = after(policy.select_action(before(as_lerobot(spec, observation))))[0]
            ours = torch.from_numpy(player.select_action(observation))
            torch.testing.assert_close(ours, theirs, atol=1e-6, rtol=0)
            # On a grid, so that action logs are short.
            assert torch.equal(ours * 2**20, torch.round(ours * 2**20))


def test_players_of_one_checkpoint_believe_what_each_has_seen(played):
    spec, _, folder = played
    first, second = observations(spec, 2)
    one_player, other = (CheckpointPolicy(folder, spec) for _ in range(2))
    fresh = one_player.select_action(first)
    later = one_player.select_action(second)
    assert np.array_equal(other.select_action(first), fresh)
    assert np.array_equal(other.select_action(second), later)


def test_a_folder_is_another_checkpoint_once_its_weights_are_others(played, tmp_path):
    from safetensors.torch import load_file, save_file

    spec, _, folder = played
    kept = shutil.copytree(folder, tmp_path / "kept")
    [observation] = observations(spec, 1)
    before = CheckpointPolicy(kept, spec).select_action(observation)
    weights = load_file(kept / "model.safetensors")
    last = max(name for name in weights if name.startswith("network.head.") and "bias" in name)
    weights[last] += 1.0
    save_file(weights, kept / "model.safetensors")
    assert not np.array_equal(CheckpointPolicy(kept, spec).select_action(observation), before)


def test_what_is_believed_is_kept_to_the_end_of_the_episode_and_no_longer(played):
    spec, policy, _ = played
    first, second = (one(spec, observation) for observation in observations(spec, 2))
    policy.reset()
    fresh = policy.select_action(first)
    policy.select_action(second)
    assert not torch.equal(policy.select_action(first), fresh)
    policy.reset()
    assert torch.equal(policy.select_action(first), fresh)
    # Other environments than before have nothing to remember either.
    policy.select_action(second)
    twice = policy.select_action(one(spec, observations(spec, 1)[0], n=2))
    torch.testing.assert_close(twice, fresh.repeat(2, 1), atol=1e-5, rtol=0)


def test_the_compiled_network_decides_as_the_network(played):
    spec, _, folder = played
    network = load_network(folder)
    compiled = CompiledBelief(network)
    plain, fast = network.start(1), None
    goal_key, wrench_key = (read_config(folder)[key] for key in ("goal_key", "wrench_key"))
    with torch.inference_mode():
        for observation in observations(spec, 4):
            batch = one(spec, observation)
            images = {name: batch[f"observation.images.{name}"] for name in network.shape.cameras}
            state, goal, felt = (
                batch["observation.state"],
                batch.get(goal_key),
                batch.get(wrench_key),
            )
            slow_action, plain = act(network, images, state, plain, goal, felt)
            fast_action, fast = compiled(images, state, fast, goal, felt)
            torch.testing.assert_close(fast_action, slow_action, atol=1e-6, rtol=0)
            torch.testing.assert_close(fast, plain, atol=1e-6, rtol=1e-6)
    assert fast.dtype == torch.float64


# --- trained on windows ---


@pytest.fixture(scope="module")
def dataset():
    """The sample as stock lerobot-train hands it over: windows of what is observed and done."""
    from lerobot.datasets.factory import resolve_delta_timestamps
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    from hvs_suite.policies.hvs import HvsConfig

    make = SimpleNamespace(repo_id="local/sample", root=SAMPLE)
    meta = LeRobotDataset(make.repo_id, root=make.root).meta
    windows = resolve_delta_timestamps(HvsConfig(window=WINDOW, device="cpu"), meta)
    return LeRobotDataset(make.repo_id, root=make.root, delta_timestamps=windows)


@pytest.fixture(scope="module")
def batch(dataset):
    return torch.utils.data.default_collate([dataset[end] for end in ENDS])


@pytest.fixture
def learner(dataset):
    """A new policy that LeRobot made for the dataset, and may train."""
    from lerobot.policies.factory import make_policy

    from hvs_suite.policies.hvs import HvsConfig

    torch.manual_seed(0)
    config = HvsConfig(window=WINDOW, channels=8, hidden=32, device="cpu")
    return make_policy(config, ds_meta=dataset.meta).train()


def test_a_new_policy_takes_task_cell_and_prior_from_its_dataset(learner):
    spec = TASKS["align-thesis"]
    config, belief = learner.config, learner.network.belief
    assert (config.family, config.control_period_s) == (spec.family, spec.control_period_s)
    assert config.cell == as_numbers(cell_model(spec))
    assert belief.standoff.item() == pytest.approx(spec.standoff_m, abs=5e-4)
    tan = torch.tensor([config.cell["tan"][name] for name in belief.cameras])
    torch.testing.assert_close(
        belief.sizes * 2.0 * tan,
        torch.full((2,), spec.target_diameter_m).double(),
        rtol=0.02,
        atol=0.0,
    )
    # All targets lie on one level: the prior is as flat.
    variance = belief.start(1)[0, COVARIANCE].view(N_MOTION, N_MOTION).diagonal()
    assert variance[2].sqrt() < 1e-3 < variance[0].sqrt()


def test_a_batch_of_windows_trains_eyes_belief_and_head(learner, batch):
    optimizer = learner.config.get_optimizer_preset().build(learner.parameters())
    losses = []
    for _ in range(8):
        loss, parts = learner.forward(batch)
        assert {"action_loss", "tip_loss", "eih_loss", "eth_loss"} < set(parts)
        optimizer.zero_grad()
        loss.backward()
        losses.append(loss.item())
        if len(losses) == 2:  # The last layer of the gates begins at nothing.
            for name, parameter in learner.named_parameters():
                assert parameter.grad is not None, name
                assert torch.isfinite(parameter.grad).all(), name
            belief = learner.network.belief
            for parameter in (belief.log_floors, *belief.gate.parameters()):
                assert parameter.grad.abs().max() > 0.0
        optimizer.step()
    assert losses[-1] < 0.8 * losses[0]


def test_the_memory_goes_through_the_window(learner, batch):
    _, parts = learner.forward(batch)
    forgetful = {
        key: value[:, -1:] if key.startswith(("observation.", "action")) else value
        for key, value in batch.items()
    }
    _, alone = learner.forward(forgetful)
    assert alone["belief_place_loss"] != pytest.approx(parts["belief_place_loss"], rel=1e-3)


def test_frames_before_the_beginning_do_not_matter(learner, batch):
    learner.eval()
    padded = batch["observation.state_is_pad"]
    assert padded.any()
    other = dict(batch)
    for key, value in batch.items():
        if key.startswith(("observation.", "action")) and value.is_floating_point():
            other[key] = value.clone()
            other[key][padded] = torch.rand_like(value[padded])
    losses = [learner.forward(each)[1] for each in (batch, other)]
    assert losses[0] == losses[1]
    other["observation.state"] = batch["observation.state"] + 0.1
    assert learner.forward(other)[1] != losses[0]


def test_the_truth_of_a_window_is_that_of_its_frames(learner, batch, dataset):
    learner.eval()
    right = learner.forward(batch)[1]
    wrong = learner.forward({**batch, "index": batch["index"] + 20})[1]
    assert right["eih_loss"] != wrong["eih_loss"]
    # What stands in the batch of it is one frame a window, and is not asked.
    public = {key: value for key, value in batch.items() if not key.startswith("privileged.")}
    assert learner.forward(public)[1] == right


def test_the_set_point_in_training_is_the_one_in_playing(learner):
    """Playing what was recorded, the policy remembers what training gives it."""
    columns = read_columns(read_manifest(SAMPLE))
    told = set_points(columns, learner.network.cell.period_s)
    state, executed = (
        torch.from_numpy(columns[key])
        for key in ("observation.state", "privileged.action_executed")
    )
    memory = learner.network.start(1)
    nothing = {name: torch.zeros(1, SIGHTING_SIZE) for name in learner.network.shape.cameras}
    for k in range(8):
        memory = learner.network.remember(memory, nothing, state[k : k + 1, :7])
        np.testing.assert_allclose(memory[0, SET_POINT].detach(), told[k], atol=1e-5)
        memory = learner.network.commanded(memory, executed[k : k + 1])


def test_a_policy_without_a_dataset_does_not_train(batch):
    with pytest.raises(ValueError, match="dataset_meta"):
        new_policy("align-easy").forward(batch)


def test_lerobots_pipeline_delivers_what_the_loss_needs(learner, batch):
    from lerobot.policies.factory import make_pre_post_processors

    learner.eval()
    before, _ = make_pre_post_processors(learner.config)
    assert learner.forward(before(dict(batch)))[1] == learner.forward(batch)[1]


def test_the_configuration_refuses_what_the_network_cannot_read():
    from lerobot.configs import FeatureType, PolicyFeature

    policy = new_policy("align-easy")
    sound = dict(policy.config.input_features)
    for key, feature in {
        "observation.images.wrist": PolicyFeature(FeatureType.VISUAL, (3, 28, 28)),
        "observation.images.eih": PolicyFeature(FeatureType.VISUAL, (3, 28, 20)),
        "observation.state": PolicyFeature(FeatureType.STATE, (7,)),
        "observation.smell": PolicyFeature(FeatureType.STATE, (3,)),
    }.items():
        policy.config.input_features = {**sound, key: feature}
        with pytest.raises(ValueError, match=key.removeprefix("observation.images.")):
            policy.config.validate_features()
    policy.config.input_features, policy.config.cell = sound, None
    with pytest.raises(ValueError, match="cell"):
        policy.config.validate_features()
    with pytest.raises(ValueError, match="window"):
        type(policy.config)(window=0, device="cpu")


# --- a stranger's ---


def cell(**values):
    def edit(config):
        config["cell"].update(values)

    return edit


def top(**values):
    return lambda config: config.update(values)


DAMAGES = {
    **{
        f"{key} {value!r:.40}": top(**{key: value})
        for key, values in {
            "cell": [None, [], {}, "cell", 3],
            "goal_key": [3, "observation.goal_colour", "observation.state", "x" * 1000],
            "wrench_key": [[], "observation.wrench", "observation.state"],
            "channels": [None, "32", 0, -1, 1.5, True, 2**40, 4096],
            "hidden": [None, 2**31, 4096],
            "error_scale": [None, "small", 0, -1.0, 1e300],
            "control_period_s": [None, 0, -0.1, 0.05, "0.1"],
            "input_features": [None, {}, {"observation.state": {"type": "STATE", "shape": [14]}}],
        }.items()
        for value in values
    },
    **{
        f"cell.{key} {value!r:.40}": cell(**{key: value})
        for key, values in {
            "period_s": [None, 0, -1.0, 10**400, "0.1", 0.2],
            "tool_length_m": [None, -1.0, 1e9, [0.1]],
            "tan": [None, [], {}, {"eih": 0.7}, {"eih": 0.7, "eth": 0.0}, {"eih": 0.7, "eth": 1e9}],
            "eth_origin": [None, [0.0], [0.0] * 4, [0.0, 0.0, 1e9], ["a", "b", "c"]],
            "eth_rotation": [
                None, [1.0] * 9, [[1.0, 0.0, 0.0]] * 3, [[0.0] * 3] * 3, [[2.0, 0, 0]] * 3,
                [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]],
            ],
            "more": [1.0],
        }.items()
        for value in values
    },
}  # fmt: skip


@pytest.mark.timeout(20)
@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_checkpoint_is_refused_in_one_line(checkpoint, tmp_path, damage):
    folder = tmp_path / "strange"
    shutil.copytree(checkpoint, folder)
    config = json.loads((folder / "config.json").read_text())
    DAMAGES[damage](config)
    (folder / "config.json").write_text(json.dumps(config))
    with pytest.raises(PolicyError) as refusal:
        policy_factory(str(folder), "align-easy")(SimpleNamespace(spec=TASKS["align-easy"]))
    assert len(str(refusal.value).splitlines()) == 1
    assert len(str(refusal.value)) < 600


def test_a_policy_for_another_task_is_refused(checkpoint):
    with pytest.raises(PolicyError, match="trained for the family align"):
        CheckpointPolicy(checkpoint, TASKS["track-line"])
