"""Where the network looks, drawn: a row a camera, the attention on the picture it belongs to."""

import numpy as np
from PIL import Image

from hvs_suite.cli.main import run


def test_a_checkpoint_s_attention_is_drawn(checkpoint, tmp_path):
    out = tmp_path / "attention.png"
    words = ["study", "attention", "--policy", str(checkpoint), "--task", "align-easy"]
    assert run([*words, "--out", str(out)]) == 0
    with Image.open(out) as picture:
        pixels = np.asarray(picture.convert("RGB")).astype(int)
    assert pixels.shape[1] > pixels.shape[0] > 400
    yellow = (pixels[..., 0] > 200) & (pixels[..., 1] > 170) & (pixels[..., 2] < 120)
    assert yellow.any()


def test_what_has_no_network_is_refused(tmp_path, capsys):
    words = ["study", "attention", "--policy", "zero", "--task", "align-easy"]
    assert run([*words, "--out", str(tmp_path / "x.png")]) == 2
    assert "no network" in capsys.readouterr().err
