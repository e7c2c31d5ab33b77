"""Frames of datasets, read back and compared."""

import io
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
from PIL import Image

IMAGES = ("observation.images.eih", "observation.images.eth")


def columns(root):
    """All frames of a dataset by column, images as PNG bytes, in order of their index."""
    tables = [pq.read_table(path) for path in sorted(Path(root, "data").glob("*/*.parquet"))]
    rows = sorted((row for table in tables for row in table.to_pylist()), key=lambda r: r["index"])
    return {name: [row[name] for row in rows] for name in rows[0]}


def assert_same_frames(one, two):
    """Two datasets hold the same frames."""
    before, after = columns(one), columns(two)
    assert before.keys() == after.keys()
    for name in before.keys() - set(IMAGES):
        assert before[name] == after[name], name
    for name in IMAGES:
        for frame, (left, right) in enumerate(zip(before[name], after[name], strict=True)):
            # Another process may round a pixel otherwise; another scene would change thousands.
            assert np.count_nonzero(pixels(left) - pixels(right)) <= 5, (name, frame)


def pixels(stored):
    """A stored image as signed numbers (H, W, 3)."""
    return np.array(Image.open(io.BytesIO(stored["bytes"]))).astype(int)
