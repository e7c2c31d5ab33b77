"""Datasets on the Hugging Face Hub, and their conversion to video, both through LeRobot.

LeRobot finds the access token itself (``HF_TOKEN`` or an earlier login); it never passes through
our code, and is removed from error messages.
"""

import contextlib
import dataclasses
import os
import re
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from hvs_suite.datasets import reader
from hvs_suite.datasets.card import TAGS
from hvs_suite.datasets.metadata import METADATA_FILE, read_metadata
from hvs_suite.errors import DatasetError, OptionError, ServerError

_REPO = re.compile(r"[A-Za-z0-9][\w.-]{0,95}/[A-Za-z0-9][\w.-]{0,95}", re.ASCII)
# Named so that LeRobot does not probe torchcodec, which complains at length without FFmpeg.
_VIDEO_BACKEND = "pyav"


@dataclasses.dataclass(frozen=True)
class Encoding:
    """How pictures become video; LeRobot's own choice by default.

    Attributes:
        codec: LeRobot's name of the encoder.
        crf: Constant rate factor; lower is better and larger.
        pixel_format: FFmpeg's name; yuv420p keeps a colour for four pixels, yuv444p for each.
        keyframe_interval: Frames from one that is kept whole to the next.
    """

    codec: str = "libsvtav1"
    crf: int = 30
    pixel_format: str = "yuv420p"
    keyframe_interval: int = 2


def check_repository(repository: str) -> None:
    """Refuses what is no name of a repository, and an environment that forbids the network.

    Raises:
        OptionError: It is malformed.
        ServerError: ``HF_HUB_OFFLINE`` is set.
    """
    if not _REPO.fullmatch(repository):
        raise OptionError(f"{repository!r} names no repository; write user/name")
    if os.environ.get("HF_HUB_OFFLINE", "").upper() in ("1", "ON", "YES", "TRUE"):
        raise ServerError("HF_HUB_OFFLINE is set; unset it to push to the Hub")


def push(root: Path, repository: str, card: str, licence: str, *, private: bool) -> None:
    """Pushes a dataset to the Hub with LeRobot's ``push_to_hub``.

    Args:
        root: The dataset.
        repository: ``user/name``.
        card: Text of the card, which LeRobot puts into its own template.
        licence: Identifier of the licence.
        private: Make the repository private.

    Raises:
        OptionError: The repository's name is malformed.
        ServerError: The Hub cannot be reached or refuses.
    """
    check_repository(repository)
    dataset = _open(root, repository)
    with hub_errors(repository), _quiet():
        dataset.push_to_hub(
            license=licence,
            tags=[*TAGS[1:], read_metadata(root).task],
            private=private,
            dataset_description=card,
        )


@contextlib.contextmanager
def hub_errors(repository: str) -> Iterator[None]:
    """Turns what goes wrong while something is pushed to the Hub into one typed line.

    Args:
        repository: ``user/name``.

    Raises:
        ServerError: The Hub cannot be reached or refuses.
    """
    import httpx
    from huggingface_hub.errors import HfHubHTTPError, LocalTokenNotFoundError

    try:
        yield
    except LocalTokenNotFoundError:
        raise ServerError(
            "no access token for the Hub; set HF_TOKEN, or run 'hf auth login'"
        ) from None
    except HfHubHTTPError as error:
        status = error.response.status_code if error.response is not None else 0
        hint = {
            401: "set HF_TOKEN to a token that may write",
            403: "use a token that may write there",
        }.get(status, "try again later")
        raise ServerError(f"the Hub refused {repository} with status {status}; {hint}") from None
    except (httpx.HTTPError, OSError) as error:
        raise ServerError(
            f"cannot reach the Hub ({_without_tokens(str(error))}); check the network and "
            "HF_ENDPOINT"
        ) from None


def check_encoding(encoding: Encoding) -> None:
    """Refuses what this machine's FFmpeg cannot encode, before any work is done.

    Raises:
        OptionError: The build lacks the encoder, or the encoder the pixel format.
    """
    import av

    try:
        encoder = av.codec.Codec(encoding.codec, "w")
    except av.codec.codec.UnknownCodecError:
        raise OptionError(
            f"the FFmpeg that PyAV {av.__version__} brings has no encoder {encoding.codec}; leave "
            "it out, or install a PyAV that has it"
        ) from None
    offered = [each.name for each in encoder.video_formats or ()]
    if encoding.pixel_format not in offered:
        raise OptionError(
            f"{encoding.codec} does not encode {encoding.pixel_format}; choose from "
            f"{', '.join(offered)}"
        )


def convert_to_video(root: Path, out: Path, encoding: Encoding) -> None:
    """Writes a copy of a dataset whose pictures are videos, with LeRobot's own conversion.

    Args:
        root: The dataset, with lossless images.
        out: Folder to make.
        encoding: Codec and quality.

    Raises:
        DatasetError: Its pictures are videos already, or cannot be converted.
    """
    dataset = _open(root, f"local/{root.resolve().name}")
    if dataset.meta.video_keys:
        raise DatasetError(f"{root} holds videos already; convert the lossless recording")
    from lerobot.configs.video import RGBEncoderConfig
    from lerobot.datasets.dataset_tools import convert_image_to_video_dataset

    # SVT-AV1 prints twenty lines for each video, past Python's own streams; errors remain.
    os.environ.setdefault("SVT_LOG", "1")
    with _quiet(), _own_schedule():
        convert_image_to_video_dataset(
            dataset,
            output_dir=out,
            repo_id=dataset.repo_id,
            rgb_encoder=RGBEncoderConfig(
                vcodec=encoding.codec,
                crf=encoding.crf,
                pix_fmt=encoding.pixel_format,
                g=encoding.keyframe_interval,
            ),
            num_workers=1,
        )
    # LeRobot drops the pictures' statistics on the way, without which nothing can be normalised;
    # those of the lossless frames are right to a few thousandths.
    for name in (METADATA_FILE, reader.STATS):
        shutil.copy(root / name, out / name)


def _open(root: Path, repository: str) -> Any:
    """LeRobot's view of a dataset on this disk."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    return LeRobotDataset(repository, root=root, video_backend=_VIDEO_BACKEND)


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Keeps progress bars of libraries off standard output, where results are printed."""
    with contextlib.redirect_stdout(sys.stderr):
        yield


@contextlib.contextmanager
def _own_schedule() -> Iterator[None]:
    """Gives this thread its scheduling back.

    Where it may, as root, SVT-AV1 makes the thread that calls it a real-time one for good: it would
    run before everything else on the machine, whatever its nice value.
    """
    if not hasattr(os, "sched_setscheduler"):
        yield
        return
    policy, parameter = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        yield
    finally:
        os.sched_setscheduler(0, policy, parameter)


def _without_tokens(text: str) -> str:
    """A library's complaint without anything that looks like an access token."""
    token = os.environ.get("HF_TOKEN", "")
    if token:
        text = text.replace(token, "***")
    return re.sub(r"hf_[A-Za-z0-9]{8,}", "***", text)
