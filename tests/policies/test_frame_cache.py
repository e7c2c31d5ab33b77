"""Frames on disk: drawn at random, they are the ones that were written."""

import mmap

import numpy as np
import pytest

from hvs_suite.policies.imitation.frame_cache import open_frames, read_rows

N, SIDE = 50, 37


@pytest.fixture
def frames():
    """Pictures whose rows do not end where pages of memory do."""
    return np.random.default_rng(0).integers(0, 256, (N, SIDE, SIDE, 3), np.uint8)


@pytest.mark.parametrize("is_on_disk", [False, True])
@pytest.mark.parametrize("rows", [[0], [N - 1], [3, 3, 7], list(range(N)), []])
def test_rows_are_those_that_were_asked_for(frames, tmp_path, is_on_disk, rows):
    np.save(tmp_path / "frames.npy", frames)
    opened = open_frames(tmp_path / "frames.npy") if is_on_disk else frames
    found = np.zeros((len(rows), *frames.shape[1:]), np.uint8)
    read_rows(opened, np.array(rows, np.int64), found)
    np.testing.assert_array_equal(found, frames[rows])


def test_files_stay_on_disk_and_are_not_written_to(frames, tmp_path):
    np.save(tmp_path / "frames.npy", frames)
    opened = open_frames(tmp_path / "frames.npy")
    assert isinstance(opened.base, mmap.mmap)
    with pytest.raises(ValueError, match="read-only"):
        opened[0] = 0
