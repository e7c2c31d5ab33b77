"""Small files that claim to be huge: refused before anything of that size is read or written."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from bombs import ARCHIVES, DATASETS, DOORS

SCRIPT = Path(__file__).with_name("bombs.py")
MOST_BYTES = 300 * 2**20


@pytest.fixture(scope="module")
def said(tmp_path_factory):
    done = subprocess.run(
        [sys.executable, SCRIPT, tmp_path_factory.mktemp("bombs")],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.timeout(600)
@pytest.mark.parametrize("door", DOORS)
@pytest.mark.parametrize("bomb", DATASETS)
def test_a_dataset_takes_no_memory_for_what_it_claims(bomb, door, said):
    assert said[bomb][door] is not None
    line, grown = said[bomb][door]
    assert not line.startswith("traceback"), line
    assert "\n" not in line
    # A door that has no use for the file reads the rest.
    assert line or door != "check"
    assert grown < MOST_BYTES


@pytest.mark.timeout(600)
@pytest.mark.parametrize("bomb", ARCHIVES)
def test_an_archive_takes_no_room_for_what_it_claims(bomb, said):
    assert said[bomb]["fetch"] is not None
    line, grown = said[bomb]["fetch"]
    assert line
    assert not line.startswith("traceback"), line
    assert "\n" not in line
    assert said[bomb]["left"] == []
    assert grown < MOST_BYTES
