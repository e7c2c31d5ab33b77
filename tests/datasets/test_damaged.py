"""Datasets of strangers: whatever is wrong with them, each command says so in one line."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from damages import DAMAGES

from hvs_suite.datasets import writer
from hvs_suite.datasets.check import check_dataset
from hvs_suite.datasets.demonstration import MakeEnvironment
from hvs_suite.datasets.features import dataset_features
from hvs_suite.datasets.recorder import record
from hvs_suite.datasets.replay import read_recorded
from hvs_suite.errors import HvsError
from hvs_suite.registry import TASKS

SAMPLE = Path(__file__).parents[2] / "datasets" / "samples" / "align-thesis"


@pytest.fixture(params=DAMAGES)
def damaged(request, tmp_path):
    root = tmp_path / "dataset"
    shutil.copytree(SAMPLE, root)
    DAMAGES[request.param](root)
    return root


@pytest.fixture(scope="module", autouse=True)
def one_environment():
    """Loading a task takes longer than checking the sample; what is shared is not closed."""
    with pytest.MonkeyPatch.context() as patched:
        make, made = MakeEnvironment.__call__, {}

        def remembered(self):
            key = repr(self)
            if key not in made:
                made[key] = make(self)
                made[key].close = lambda: None
            return made[key]

        patched.setattr(MakeEnvironment, "__call__", remembered)
        yield


def tried(function, *arguments, **options):
    """What a function returns, and the line that it says where it refuses."""
    try:
        return function(*arguments, **options), ""
    except HvsError as error:
        return None, str(error)


def test_check_finds_it(damaged):
    report, line = tried(check_dataset, damaged, pictures=False)
    found = [line] if report is None else [str(each) for each in report.damage]
    assert found
    assert all(each.isprintable() for each in found), found


def test_replay_reads_it_whole_or_not_at_all(damaged):
    recorded, line = tried(read_recorded, damaged, 0)
    assert (recorded is None) == bool(line)
    if recorded is not None:
        lengths = [len(recorded.actions), len(recorded.errors)]
        assert len({*lengths, *map(len, recorded.pictures.values())}) == 1


def test_training_reads_it_whole_or_not_at_all(damaged, tmp_path):
    from hvs_suite.policies.imitation.demonstrations import Demonstrations
    from hvs_suite.policies.training.dataset import read_manifest

    def read():
        return Demonstrations(read_manifest(damaged), tmp_path / "cache", seed=0)

    demonstrations, line = tried(read)
    assert (demonstrations is None) == bool(line)
    if demonstrations is not None:
        batch = demonstrations.batch(np.arange(len(demonstrations)))
        assert {len(values) for values in batch.values()} == {len(demonstrations)}


def test_a_recording_goes_on_with_it_or_refuses_and_drops_nothing(damaged):
    before = {path: path.stat().st_size for path in damaged.rglob("*.parquet")}
    done, line = tried(record, "align-thesis", 5, "train", damaged, resume=True)
    assert (done is None) == bool(line)
    assert {path: path.stat().st_size for path in damaged.rglob("*.parquet")} == before or done
    features = dataset_features(TASKS["align-thesis"])
    published, line = tried(writer._read_published, damaged, features)
    assert (published is None) == bool(line)
    assert published is None or not published.frames or set(published.stats) >= set(features)
