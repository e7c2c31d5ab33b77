"""Where the network looks, drawn: a row a camera, the attention on the picture it belongs to."""

import numpy as np
import torch
from PIL import Image

from hvs_suite.cli.main import run
from hvs_suite.policies.network.network import Eye


def test_attention_is_a_distribution_whose_mean_is_the_keypoint():
    torch.manual_seed(0)
    eye = Eye(3, 56, 8).eval()
    images = torch.rand(2, 3, 56, 56)
    with torch.no_grad():
        attention, sighting = eye.attention(images), eye(images)
    torch.testing.assert_close(attention.sum(dim=(1, 2)), torch.ones(2))
    centres = (2.0 * torch.arange(attention.shape[2]) + 1.0) / attention.shape[2] - 1.0
    mean = (attention.sum(dim=1) * centres).sum(dim=1)
    # An untrained eye corrects nothing and scales by its initial value.
    torch.testing.assert_close(sighting.uv[:, 0], mean * eye.uv_scale[0])


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
