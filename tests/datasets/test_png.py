"""Pictures as PNG files: what other libraries read from them."""

import io

import cv2
import numpy as np
import pytest
from PIL import Image

from hvs_suite.datasets.png import encode


@pytest.mark.parametrize("shape", [(1, 1, 3), (1, 5, 3), (7, 1, 3), (112, 112, 3), (336, 336, 3)])
def test_other_libraries_read_the_same_pixels(shape):
    random = np.random.default_rng(0)
    noise = random.integers(0, 256, shape, np.uint8)
    plain = np.full(shape, 200, np.uint8)
    turned = np.ascontiguousarray(noise[::-1])[::-1]
    for picture, file in zip((noise, plain, turned), encode([noise, plain, turned]), strict=True):
        with Image.open(io.BytesIO(file)) as image:
            assert (image.format, image.mode) == ("PNG", "RGB")
            image.load()
            np.testing.assert_array_equal(np.asarray(image), picture)
        found = cv2.imdecode(np.frombuffer(file, np.uint8), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(found[..., ::-1], picture)
