"""``hvs check``: a sound dataset passes, and every kind of damage is named where it is."""

import io
import json
import shutil
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from hvs_suite.cli.main import run
from hvs_suite.datasets.check import check_dataset
from hvs_suite.errors import DatasetError

SAMPLE = Path(__file__).parents[2] / "datasets" / "samples" / "align-thesis"
DATA = "data/chunk-000/file-000.parquet"
LISTED = "meta/episodes/chunk-000/file-000.parquet"
EPISODE, FRAME = 2, 4


@pytest.fixture
def copy(tmp_path):
    """A dataset to damage."""
    root = tmp_path / "copy"
    shutil.copytree(SAMPLE, root)
    return root


def change_column(root, name, change):
    """Applies ``change(list of rows' values, row of EPISODE's FRAME)`` to a column of the data."""
    table = pq.read_table(root / DATA)
    values = table.column(name).to_pylist()
    row = table.column("episode_index").to_pylist().index(EPISODE) + FRAME
    change(values, row)
    field = table.schema.field(name)
    table = table.set_column(
        table.schema.get_field_index(name), field, pa.array(values, field.type)
    )
    pq.write_table(table, root / DATA)


def change_json(root, name, change):
    content = json.loads((root / name).read_text())
    change(content)
    (root / name).write_text(json.dumps(content))


def add(amount, dimension=None):
    def change(values, row):
        if dimension is None:
            values[row] += amount
        else:
            values[row][dimension] += amount

    return change


def png(shape):
    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(np.full(shape, 200, np.uint8)).save(stream, "png")
    return {"bytes": stream.getvalue(), "path": None}


def spoil_bytes(values, row):
    stored = bytearray(values[row]["bytes"])
    middle = len(stored) // 2
    stored[middle : middle + 40] = bytes(40)
    values[row] = {**values[row], "bytes": bytes(stored)}


def swap_pictures(values, row):
    values[row], values[row - 3] = values[row - 3], values[row]


def drop_frame(root):
    table = pq.read_table(root / DATA)
    row = table.column("episode_index").to_pylist().index(EPISODE) + FRAME
    pq.write_table(pa.concat_tables([table[:row], table[row + 1 :]]), root / DATA)


def truncate(root):
    content = (root / DATA).read_bytes()
    (root / DATA).write_bytes(content[: len(content) // 2])


def drop_column(root):
    pq.write_table(pq.read_table(root / DATA).drop_columns(["next.reward"]), root / DATA)


def replace_row(new):
    def change(values, row):
        values[row] = new

    return change


def of_column(name, change):
    return lambda root: change_column(root, name, change)


def of_json(name, change):
    return lambda root: change_json(root, name, change)


EIH, ETH = "observation.images.eih", "observation.images.eth"
NAN_ACTION = [float("nan"), *[0.0] * 6]
# What is done to the dataset; file, episode and frame that must be named; words that say what.
DAMAGE = {
    "a killed copy of the data": (truncate, DATA, None, None, "cannot be read"),
    "a missing file": (lambda root: (root / DATA).unlink(), DATA, None, None, "missing"),
    "a dropped frame": (drop_frame, DATA, EPISODE, FRAME, "frame_index"),
    "a dropped column": (drop_column, DATA, None, None, "next.reward"),
    "spoilt image bytes": (of_column(EIH, spoil_bytes), DATA, EPISODE, FRAME, "decoded"),
    "no image at all": (of_column(ETH, replace_row(None)), DATA, EPISODE, FRAME, "no image"),
    "an image of another size": (
        of_column(ETH, replace_row(png((64, 64, 3)))), DATA, EPISODE, FRAME, "(64, 64, 3)",
    ),
    "images of other moments": (
        of_column(ETH, swap_pictures), DATA, EPISODE, FRAME - 3, "another scene",
    ),
    "a shifted timestamp": (of_column("timestamp", add(0.05)), DATA, EPISODE, FRAME, "timestamp"),
    "a wrong index": (of_column("index", add(1)), DATA, EPISODE, FRAME, "index is"),
    "another scenario": (
        of_column("privileged.scenario", add(1)), DATA, EPISODE, FRAME, "scenario changes",
    ),
    "an altered state": (
        of_column("observation.state", add(1e-3, 3)), DATA, EPISODE, FRAME, "A4.pos",
    ),
    "an altered executed action": (
        of_column("privileged.action_executed", add(-2e-3, 5)),
        DATA, EPISODE, FRAME + 1, "observation.state",
    ),
    "an altered label": (of_column("action", add(1e-3, 5)), DATA, EPISODE, FRAME, "no noise"),
    "a label that is no number": (
        of_column("action", replace_row(NAN_ACTION)), DATA, EPISODE, FRAME, "NaN",
    ),
    "a success that was none": (
        of_column("next.success", replace_row(True)), DATA, EPISODE, FRAME, "next.success",
    ),
    "an end too early": (
        of_column("next.done", replace_row(True)), DATA, EPISODE, FRAME, "before the last",
    ),
    "other statistics": (
        of_json("meta/stats.json", lambda stats: stats["action"]["mean"].__setitem__(0, 0.7)),
        "meta/stats.json", None, None, "action: mean[0] is 0.7",
    ),
    "counts beyond the files": (
        of_json("meta/info.json", lambda info: info.update(total_episodes=7)),
        "meta/info.json", None, None, "total_episodes is 7, not 5",
    ),
    "other names": (
        of_json("meta/info.json", lambda info: info["features"]["action"].update(names=None)),
        "meta/info.json", None, None, "names of action",
    ),
    "no JSON": (
        lambda root: (root / "meta/info.json").write_text("{"),
        "meta/info.json", None, None, "is not JSON",
    ),
    "another split": (
        of_json("hvs.json", lambda origin: origin.update(split="test")), DATA, 0, 0, "privileged",
    ),
    "no list of episodes": (
        lambda root: (root / LISTED).unlink(), "meta/episodes", None, None, "missing",
    ),
}  # fmt: skip


def test_the_sample_is_sound():
    report = check_dataset(SAMPLE)
    assert [str(each) for each in report.damage] == []
    assert report.episodes == 5
    assert report.frames > 50


@pytest.mark.parametrize("kind", DAMAGE)
def test_finds_and_names(kind, copy):
    spoil, file, episode, frame, words = DAMAGE[kind]
    spoil(copy)
    found = check_dataset(copy).damage
    assert [
        each
        for each in found
        if (each.file, each.episode, each.frame) == (file, episode, frame) and words in each.what
    ], [str(each) for each in found]


def test_pictures_in_dictionaries_are_read_as_any_others(copy):
    """As LeRobot's own writer leaves them, row group by row group."""
    table = pq.read_table(copy / DATA)
    pq.write_table(
        table, copy / DATA, row_group_size=7, use_dictionary=True, dictionary_pagesize_limit=9000
    )
    assert [str(each) for each in check_dataset(copy).damage] == []


def test_damage_of_one_episode_is_not_laid_to_others(copy):
    change_column(copy, "observation.state", add(1e-3, 3))
    found = check_dataset(copy, pictures=False).damage
    assert {each.episode for each in found if each.file == DATA} == {EPISODE}


def test_two_processes_find_what_one_does(copy):
    change_column(copy, EIH, spoil_bytes)
    assert check_dataset(copy, workers=2, pictures=False) == check_dataset(copy, pictures=False)


def test_command_prints_a_line_for_each_place_and_exits_with_1(copy, capsys):
    assert run(["check", str(copy), "--skip-pictures"]) == 0
    capsys.readouterr()
    change_column(copy, EIH, spoil_bytes)
    assert run(["check", str(copy), "--skip-pictures"]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert f"{DATA}: episode {EPISODE}, frame {FRAME}: {EIH} cannot be decoded" in lines[0]
    assert "1 damaged place" in lines[-1]
    assert run(["check", str(copy), "--skip-pictures", "--json"]) == 1
    [found] = json.loads(capsys.readouterr().out)["damage"]
    assert (found["file"], found["episode"], found["frame"]) == (DATA, EPISODE, FRAME)


def test_a_folder_without_a_dataset_and_another_task_are_refused(copy, tmp_path, capsys):
    (tmp_path / "empty").mkdir()
    with pytest.raises(DatasetError, match="no dataset"):
        check_dataset(tmp_path / "empty")
    change_json(copy, "hvs.json", lambda origin: origin.update(task_digest="0" * 64))
    assert run(["check", str(copy)]) == 2
    err = capsys.readouterr().err
    assert "digest 000000000000" in err
    assert err.count("\n") == 1
