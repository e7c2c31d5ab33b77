"""What the tests of policies share: a small dataset, a policy trained on it, and one untrained."""

from pathlib import Path

import miniature
import pytest


@pytest.fixture(scope="session")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Forty frames in ten episodes, at 28 px."""
    root = tmp_path_factory.mktemp("data") / "miniature"
    miniature.write_dataset(root, miniature.scene(40), miniature.episodes(40), n_files=2)
    return root


@pytest.fixture(scope="session")
def large_dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight frames in two episodes, at the 112 px of the easy tasks."""
    root = tmp_path_factory.mktemp("data") / "large"
    miniature.write_dataset(root, miniature.scene(8, side=112), miniature.episodes(8))
    return root


@pytest.fixture(scope="session")
def checkpoint(large_dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Checkpoint that fits the easy tasks, trained for two steps."""
    from hvs_suite.policies.imitation.pretrain import pretrain

    out = tmp_path_factory.mktemp("checkpoint")
    pretrain(large_dataset, out, steps=2, batch_size=4, windows=4, window_steps=4)
    return out


@pytest.fixture(scope="module")
def base(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A policy that nobody has trained, for the task that the test's module names as `TASK`."""
    from test_hvs_policy import new_policy

    from hvs_suite.policies.hvs.modeling_hvs import save_checkpoint

    folder = tmp_path_factory.mktemp("base")
    save_checkpoint(new_policy(request.module.TASK), folder)
    return folder
