"""The dataset card: what a dataset holds and how it was made.

``README.md`` with the front matter that the Hub reads, and one picture, written into the dataset.
"""

import dataclasses
import re
from pathlib import Path
from typing import Any

import numpy as np

from hvs_suite.cell.robot import JOINT_NAMES
from hvs_suite.datasets import reader
from hvs_suite.datasets.features import SCENARIO, image_key
from hvs_suite.datasets.metadata import EXPERT, DatasetMetadata, read_metadata
from hvs_suite.files import replacing
from hvs_suite.names import shown
from hvs_suite.registry import find
from hvs_suite.tasks.shared.lock import digest
from hvs_suite.tasks.shared.spec import Spec

CARD = "README.md"
PICTURE = "pictures.png"
LICENCE = "apache-2.0"
TAGS = ("LeRobot", "robotics", "visual-servoing", "kuka-lbr-iiwa", "hvs-suite")

_TILE_PX = 160
_COLUMNS = 6


@dataclasses.dataclass(frozen=True)
class Contents:
    """What a card counts.

    Attributes:
        episodes: Episodes.
        frames: Frames.
        successes: Episodes that reached the goal.
        mean_steps: Mean control steps of an episode.
        scenarios: Least and greatest scenario index.
        size_mb: Size of all files (MB).
    """

    episodes: int
    frames: int
    successes: int
    mean_steps: float
    scenarios: tuple[int, int]
    size_mb: float


def write_card(root: Path, licence: str = LICENCE) -> str:
    """Writes card and picture into a dataset.

    Args:
        root: The dataset.
        licence: Identifier of its licence.

    Returns:
        The card's text without its front matter.

    Raises:
        DatasetError: The dataset is damaged.
        OutputError: The folder cannot be written.
    """
    metadata = read_metadata(root)
    info = reader.read_info(root)
    with replacing(root / PICTURE) as temporary:
        draw_pictures(root, info).save(temporary, "PNG")
    body = describe(metadata, info, count(root), licence)
    with replacing(root / CARD) as temporary:
        temporary.write_text(_front_matter(metadata, licence) + body, encoding="utf-8")
    return body


def count(root: Path) -> Contents:
    """Counts what a dataset holds.

    Raises:
        DatasetError: It is damaged.
    """
    outcomes: dict[int, bool] = {}
    scenarios: list[int] = []
    frames = 0
    for file in sorted({place.file for place in reader.read_places(root)}):
        rows = reader.read_numbers(root, file, ["episode_index", "next.success", SCENARIO])
        frames += len(rows[SCENARIO])
        scenarios += rows[SCENARIO].tolist()
        for episode, success in zip(rows["episode_index"], rows["next.success"], strict=True):
            outcomes[int(episode)] = outcomes.get(int(episode), False) or bool(success)
    own = (CARD, PICTURE)
    size = sum(
        path.stat().st_size
        for path in root.rglob("*")
        if path.is_file() and path.relative_to(root).as_posix() not in own
    )
    return Contents(
        len(outcomes),
        frames,
        sum(outcomes.values()),
        frames / max(1, len(outcomes)),
        (min(scenarios, default=0), max(scenarios, default=0)),
        size / 1e6,
    )


def describe(
    metadata: DatasetMetadata, info: dict[str, Any], contents: Contents, licence: str
) -> str:
    """The card's text, Markdown.

    Args:
        metadata: Origin of the dataset.
        info: LeRobot's ``info.json``.
        contents: What it holds.
        licence: Identifier of its licence.
    """
    spec = find(metadata.task).with_options(metadata.options)
    share = 100.0 * contents.successes / max(1, contents.episodes)
    options = ", ".join(_code(f"{k}={v!r}") for k, v in sorted(metadata.options.items()))
    noise = (
        f"temporally correlated, {metadata.noise:g} rad far from the goal, on what is executed "
        f"(`privileged.action_executed`); `action` is the demonstrator's own"
        if metadata.noise
        else "none: `action` is what was executed"
    )
    rows = {
        "task": f"`{metadata.task}`, version {metadata.task_version}",
        "task digest": f"`{metadata.task_digest or digest(metadata.task)}`",
        "options": options or "as named",
        "instruction": spec.instruction(),
        "robot": f"KUKA LBR iiwa 7 R800, {JOINT_NAMES[0]} to {JOINT_NAMES[-1]}, simulated (MuJoCo)",
        "split and scenarios": f"{_code(metadata.split)}, {contents.scenarios[0]} to "
        f"{contents.scenarios[1]}",
        "episodes": f"{contents.episodes:,}",
        "frames": f"{contents.frames:,} at {info['fps']} a second, "
        f"{contents.mean_steps:.1f} an episode",
        "success": f"{contents.successes:,} of {contents.episodes:,} ({share:.1f} %)",
        "demonstrator": "the suite's scripted expert: time-optimal motion within the limits of "
        "joint speed and acceleration, replanned every step from the true state"
        if metadata.demonstrator == EXPERT
        else _code(metadata.demonstrator),
        "noise": noise,
        "images": _images(info),
        "size": f"{contents.size_mb:.1f} MB",
        "licence": licence,
    }
    command = shown(metadata.command) or "# the command was not kept"
    # A fence longer than any in the command: the text inside cannot close it.
    fence = "`" * max(3, 1 + max((len(run) for run in re.findall("`+", command)), default=0))
    lines = [
        f"# {metadata.task}: demonstrations for visual servoing",
        "",
        f"![Camera pictures of the first episode, from start to goal]({PICTURE})",
        "",
        f"{_tolerance(spec)} Recorded with hvs_suite in LeRobot's format "
        f"{info.get('codebase_version', 'v3.0')}.",
        "",
        "| | |",
        "|---|---|",
        *(f"| {name} | {value} |" for name, value in rows.items()),
        "",
        "Made by:",
        "",
        fence + "sh",
        command,
        fence,
        "",
        "`observation.*` is what a policy may see. `privileged.*` is the simulator's truth, for "
        "training and checks only. `hvs.json` holds task, split, options and noise, from which "
        "`hvs check` plays every episode again and compares.",
        "",
    ]
    return "\n".join(lines)


def draw_pictures(root: Path, info: dict[str, Any]) -> Any:
    """Camera pictures of the first episode, evenly spaced in time, one row a camera.

    Args:
        root: The dataset.
        info: LeRobot's ``info.json``.

    Returns:
        A ``PIL.Image``.

    Raises:
        DatasetError: They cannot be read.
    """
    from hvs_suite.pictures import resize, strip

    place = min(reader.read_places(root), key=lambda each: each.episode)
    table = reader.read_episode(root, place)
    titles = {"eih": "eye in hand", "eth": "eye to hand"}
    cameras = [camera for camera in titles if image_key(camera) in info["features"]]
    steps = np.unique(np.linspace(0, place.length - 1, _COLUMNS).round().astype(int))
    fps = info["fps"]
    rows = {}
    for camera in cameras:
        pictures = reader.read_pictures(root, info, place, table, image_key(camera))
        rows[titles[camera]] = [resize(pictures[step], _TILE_PX) for step in steps]
    return strip(rows, [step / fps for step in steps])


def _front_matter(metadata: DatasetMetadata, licence: str) -> str:
    """The YAML that the Hub reads."""
    tags = [*TAGS, metadata.task]
    return "\n".join(
        [
            "---",
            f"license: {licence}",
            "task_categories:",
            "- robotics",
            "tags:",
            *(f"- {tag}" for tag in tags),
            "configs:",
            "- config_name: default",
            "  data_files: data/*/*.parquet",
            "---",
            "",
            "",
        ]
    )


def _images(info: dict[str, Any]) -> str:
    """Each camera's size and how its pictures are kept."""
    kept = []
    for key, feature in sorted(info["features"].items()):
        if feature["dtype"] in ("image", "video"):
            height, width = feature["shape"][:2]
            how = "PNG, lossless"
            if feature["dtype"] == "video":
                video = feature.get("info") or {}
                codec = str(video.get("video.codec"))
                # Any other text is not the name of a codec and is left out.
                codec = codec if re.fullmatch(r"[a-z0-9_.-]{1,32}", codec) else "unknown"
                how = f"video, {codec}, lossy"
            kept.append(f"{_code(key)} {width} x {height} px ({how})")
    return "; ".join(kept) or "none"


def _code(text: str) -> str:
    """Untrusted text as code in a table, with everything escaped that could end it."""
    plain = shown(text).replace("`", "'").replace("|", "\\|")
    return f"`{plain}`"


def _tolerance(spec: Spec) -> str:
    """What has to be done, in two sentences."""
    words = spec.describe()
    held = f", held for {words.held}" if words.held else ""
    return (
        f"{spec.instruction()} Target: {words.target}; within {words.tolerance}{held}, in at most "
        f"{spec.time_limit_steps} steps of {spec.control_period_s:g} s."
    )
