"""Checking a dataset: is every frame there, intact, and equal to what the simulation gives?

Damage is collected, not raised; each place is given by file, episode and frame. Episodes are
independent, so several processes share them.
"""

import contextlib
import dataclasses
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, Self

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from hvs_suite.datasets import reader
from hvs_suite.datasets.demonstration import MakeEnvironment
from hvs_suite.datasets.features import (
    ACTION,
    ACTION_EXECUTED,
    ROBOT_TYPE,
    SCENARIO,
    dataset_features,
)
from hvs_suite.datasets.metadata import METADATA_FILE, DatasetMetadata, read_metadata
from hvs_suite.datasets.moments import Moments, compare, compare_all, merge, sample
from hvs_suite.datasets.reader import DamagedFileError, Place
from hvs_suite.datasets.resimulation import resimulate
from hvs_suite.errors import DatasetError, HvsError, ScenarioError
from hvs_suite.executor import Workers
from hvs_suite.names import shown
from hvs_suite.registry import find
from hvs_suite.rollout import play
from hvs_suite.tasks.shared.lock import digest
from hvs_suite.tasks.shared.spec import Spec

LEROBOT_COLUMNS = ("timestamp", "frame_index", "episode_index", "index", "task_index")
# Their values are checked one by one; their statistics mean nothing, and LeRobot's own merge leaves
# them as they were.
_NUMBERING = ("episode_index", "index", "task_index")
_TIME_TOLERANCE_S = 1e-4
_VIDEO_SLACK = 0.03
_LISTED_DAMAGE = 3


@dataclasses.dataclass(frozen=True)
class Damage:
    """One damaged place.

    Attributes:
        file: The file, relative to the dataset.
        episode: The episode, where it is in one.
        frame: The frame of the episode, where it is in one.
        what: What is wrong.
    """

    file: str
    episode: int | None
    frame: int | None
    what: str

    @classmethod
    def of(cls, error: DamagedFileError, episode: int | None = None) -> Self:
        """What a reader found."""
        return cls(error.file, episode, None, error.what)

    def __str__(self) -> str:
        """One line, whatever the names and texts in the dataset hold."""
        where = [self.file]
        if self.episode is not None:
            frame = "" if self.frame is None else f", frame {self.frame}"
            where.append(f"episode {self.episode}{frame}")
        return shown(": ".join([*where, self.what]))


@dataclasses.dataclass(frozen=True)
class Report:
    """What a check found.

    Attributes:
        episodes: Episodes looked at.
        frames: Frames looked at.
        damage: Every damaged place.
    """

    episodes: int
    frames: int
    damage: tuple[Damage, ...]


def check_dataset(
    root: Path,
    *,
    metadata: DatasetMetadata | None = None,
    workers: Workers = 1,
    pictures: bool = True,
    progress: Callable[[int, int], None] | None = None,
) -> Report:
    """Checks a dataset made by ``hvs record``.

    Args:
        root: The dataset.
        metadata: Origin to compare it with; the dataset's own by default.
        workers: Processes that share the episodes, or others elsewhere that see the same folder.
        pictures: Also draw every frame again and compare; decoding is checked in any case.
        progress: Called after each episode with the number checked and of all.

    Returns:
        What was found.

    Raises:
        DatasetError: There is no dataset here, or it belongs to another meaning of its task.
        RenderError: Pictures cannot be drawn on this machine.
    """
    if not (root / "meta").exists() and not (root / METADATA_FILE).exists():
        raise DatasetError(f"{root} holds no dataset; name the root of one made by 'hvs record'")
    try:
        metadata = metadata or read_metadata(root)
        spec = find(metadata.task).with_options(metadata.options)
        features = dataset_features(spec)
    except HvsError as error:
        return Report(0, 0, (Damage(METADATA_FILE, None, None, str(error)),))
    _check_same_task(root, metadata, spec)
    damage: list[Damage] = []
    try:
        info = reader.read_info(root)
        places = reader.read_places(root)
    except DamagedFileError as error:
        return Report(0, 0, (Damage.of(error),))
    damage += _check_info(info, features, spec, places)
    sentences = _read_sentences(root, damage)
    damage += _check_order(places)
    damage += _check_videos(info, places)
    unreadable, in_files = _check_files(root, places, features)
    damage += in_files
    sound = [place for place in places if place.file not in unreadable]
    job = CheckEpisode(
        root.resolve(),
        metadata,
        {place.episode: place for place in sound},
        features,
        info,
        sentences,
        pictures,
    )
    options = dict(metadata.options) if pictures else {**metadata.options, "observations": "state"}
    merged: dict[str, list[Moments]] = {}
    said: dict[int, str] = {}
    checked = frames = 0
    with contextlib.closing(
        play(
            MakeEnvironment(metadata.task, metadata.split, options),
            _no_policy,
            [place.episode for place in sound],
            job,
            workers=workers,
        )
    ) as played:
        for found in played:
            damage += found.damage
            if found.sentence:
                said[found.episode] = found.sentence
            checked, frames = checked + 1, frames + found.frames
            for name, moments in found.moments.items():
                merged.setdefault(name, []).append(moments)
            if progress is not None:
                progress(checked, len(sound))
    if not unreadable and frames != info.get("total_frames"):
        what = f"counts {info.get('total_frames')} frames, {frames} are there"
        damage.append(Damage(reader.INFO, None, None, what))
    if not unreadable:
        # A feature that some episode could not give has no statistics to compare.
        whole = {name: each for name, each in merged.items() if len(each) == checked}
        damage += _check_statistics(root, info, features, whole)
        # A recording lists them as they come; LeRobot's tools do not keep the order.
        wanted = sorted(set(said.values()))
        if sentences and wanted and sorted(sentences) != wanted:
            what = f"{sorted(sentences)} is not what the episodes are about, {wanted}"
            damage.append(Damage(reader.TASKS, None, None, what))
    return Report(checked, frames, tuple(sorted(set(damage), key=_order)))


@dataclasses.dataclass(frozen=True)
class EpisodeFindings:
    """What one episode shows.

    Attributes:
        episode: Its index.
        frames: Rows found.
        damage: Every damaged place.
        moments: Of each feature.
        sentence: What was to be done, by the scenario; empty where that is damaged.
    """

    episode: int
    frames: int
    damage: list[Damage]
    moments: dict[str, Moments]
    sentence: str = ""


@dataclasses.dataclass(frozen=True)
class CheckEpisode:
    """Checks one episode; for :func:`hvs_suite.rollout.play`, with the episode as the index.

    Attributes:
        root: The dataset.
        metadata: Its origin.
        places: Where each episode lies.
        features: The features it must have.
        info: ``meta/info.json``.
        sentences: ``meta/tasks.parquet``; empty where it is damaged.
        pictures: Draw every frame again.
    """

    root: Path
    metadata: DatasetMetadata
    places: Mapping[int, Place]
    features: Mapping[str, Mapping[str, Any]]
    info: Mapping[str, Any]
    sentences: list[str]
    pictures: bool

    def __call__(self, env: Any, policy: Any, episode: int) -> EpisodeFindings:
        """Checks the episode."""
        place = self.places[episode]
        findings = EpisodeFindings(episode, 0, [], {})
        try:
            table = reader.read_episode(self.root, place)
        except DamagedFileError as error:
            findings.damage.append(Damage.of(error, episode))
            return findings
        columns = self._columns(place, table, findings)
        sentence = _sentence(env, columns)
        self._check_numbering(place, columns, sentence, findings)
        lossy = bool(place.videos)
        decoded = {
            key: self._decode(place, table, key, findings)
            for key, feature in self.features.items()
            if feature["dtype"] == "image"
        }
        self._check_episode_statistics(place, columns, decoded, findings)
        if self._can_be_played(place, columns, findings):
            differences = resimulate(
                env,
                find(self.metadata.task).with_options(self.metadata.options),
                columns,
                self.features,
                picture=(lambda key, frame: decoded[key].get(frame)) if self.pictures else None,
                lossy=lossy,
            )
            for each in differences:
                findings.damage.append(
                    Damage(place.file, episode, each.frame, f"{each.column}: {each.what}")
                )
        return dataclasses.replace(findings, frames=table.num_rows, sentence=sentence)

    def _columns(
        self, place: Place, table: pa.Table, findings: EpisodeFindings
    ) -> dict[str, npt.NDArray[Any]]:
        """All columns of numbers; those that are missing or have another shape are damage."""
        columns = {}
        for name, feature in self._numeric().items():
            if name not in table.column_names:
                continue  # Said once for the whole file.
            try:
                values = reader.column(table, name)
            except DatasetError as error:
                findings.damage.append(Damage(place.file, place.episode, None, str(error)))
                continue
            width = tuple(feature["shape"])
            shape = (table.num_rows,) if width == (1,) else (table.num_rows, *width)
            if values.shape != shape:
                what = f"{name} has shape {values.shape[1:]}, not {width}"
                findings.damage.append(Damage(place.file, place.episode, None, what))
                continue
            columns[name] = values
            finite = np.isfinite(values.astype(np.float64))
            bad = np.flatnonzero(~finite.all(axis=tuple(range(1, finite.ndim))))
            if len(bad):
                what = f"{name} holds NaN or infinity"
                findings.damage.append(Damage(place.file, place.episode, int(bad[0]), what))
        return columns

    def _numeric(self) -> dict[str, Mapping[str, Any]]:
        own = {name: each for name, each in self.features.items() if each["dtype"] != "image"}
        return own | {name: {"shape": (1,)} for name in LEROBOT_COLUMNS}

    def _check_numbering(
        self,
        place: Place,
        columns: Mapping[str, npt.NDArray[Any]],
        sentence: str,
        findings: EpisodeFindings,
    ) -> None:
        """Indices, timestamps, ends and scenario: one after the other, without a hole."""
        count = len(next(iter(columns.values()))) if columns else 0

        def say(frame: int | None, what: str) -> None:
            findings.damage.append(Damage(place.file, place.episode, frame, what))

        if count != place.length:
            say(None, f"{count} frames are there, {place.length} are listed")
        period_s = find(self.metadata.task).control_period_s
        period_s = float(self.metadata.options.get("control_period_s", period_s))
        fps = round(1.0 / period_s)
        steps = np.arange(count)
        expected = {
            "frame_index": steps,
            "index": place.start + steps,
            "timestamp": steps / fps,
        }
        if sentence in self.sentences:
            expected["task_index"] = np.full(count, self.sentences.index(sentence))
        for name, wanted in expected.items():
            if name in columns:
                wrong = np.flatnonzero(np.abs(columns[name] - wanted) > _TIME_TOLERANCE_S)
                if len(wrong):
                    frame = int(wrong[0])
                    say(frame, f"{name} is {columns[name][frame]:g}, not {wanted[frame]:g}")
        if "next.done" in columns and count:
            early = np.flatnonzero(columns["next.done"][:-1])
            if len(early):
                say(int(early[0]), "next.done is set before the last frame")
            if not columns["next.done"][-1]:
                say(count - 1, "next.done is not set on the last frame")
        if SCENARIO in columns:
            changed = np.flatnonzero(columns[SCENARIO] != columns[SCENARIO][:1])
            if len(changed):
                say(int(changed[0]), f"{SCENARIO} changes within the episode")

    def _decode(
        self, place: Place, table: pa.Table, key: str, findings: EpisodeFindings
    ) -> dict[int, npt.NDArray[np.uint8]]:
        """The pictures of a camera by frame; those that cannot be decoded are damage."""
        if key in place.videos:
            return self._decode_video(place, key, findings)
        pictures = {}
        shape = reader.shape_of({"features": self.features}, key)
        for frame, stored in enumerate(table.column(key) if key in table.column_names else ()):
            try:
                pictures[frame] = reader.decode(stored.as_py(), shape)
            except DatasetError as error:
                what = f"{key} {error}"
                findings.damage.append(Damage(place.file, place.episode, frame, what))
        return pictures

    def _decode_video(
        self, place: Place, key: str, findings: EpisodeFindings
    ) -> dict[int, npt.NDArray[np.uint8]]:
        file, _ = place.videos[key]
        try:
            pictures = reader.decode_video(self.root, self.info, place, key)
        except DamagedFileError as error:
            findings.damage.append(Damage.of(error, place.episode))
            return {}
        if len(pictures) < place.length:
            what = f"ends after {len(pictures)} of {place.length} frames"
            findings.damage.append(Damage(file, place.episode, len(pictures), what))
        return dict(enumerate(pictures))

    def _check_episode_statistics(
        self,
        place: Place,
        columns: Mapping[str, npt.NDArray[Any]],
        decoded: Mapping[str, Mapping[int, npt.NDArray[np.uint8]]],
        findings: EpisodeFindings,
    ) -> None:
        """Compares the episode's listed statistics, and keeps its moments for the dataset's."""
        try:
            listed = reader.listed_statistics(self.root, place)
        except DamagedFileError as error:
            findings.damage.append(Damage.of(error, place.episode))
            return
        for name, values in columns.items():
            if name in listed and name not in _NUMBERING and len(values):
                findings.moments[name] = Moments.of(values.reshape(len(values), -1))
        for key, pictures in decoded.items():
            shapes = {picture.shape for picture in pictures.values()}
            if key in listed and len(pictures) == place.length and len(shapes) == 1:
                findings.moments[key] = sample([pictures[i] for i in range(place.length)])
        for name, moments in findings.moments.items():
            slack = _VIDEO_SLACK if name in place.videos else 0.0
            wrong = compare(moments, listed[name], slack)
            if wrong:
                what = f"statistics of {name}: {wrong}"
                findings.damage.append(Damage(place.listed_in, place.episode, None, what))

    def _can_be_played(
        self, place: Place, columns: Mapping[str, npt.NDArray[Any]], findings: EpisodeFindings
    ) -> bool:
        """Whether the executed actions are all there and such as the task takes."""
        if not {ACTION, ACTION_EXECUTED, SCENARIO} <= set(columns):
            return False
        executed, action = columns[ACTION_EXECUTED], columns[ACTION]
        if not len(executed) or not np.isfinite(executed).all():
            return False
        outside = np.flatnonzero((np.abs(executed) > 1.0).any(axis=1))
        if len(outside):
            what = f"{ACTION_EXECUTED} leaves [-1, 1]"
            findings.damage.append(Damage(place.file, place.episode, int(outside[0]), what))
            return False
        if self.metadata.noise == 0.0:
            other = np.flatnonzero((executed != action).any(axis=1))
            if len(other):
                what = f"{ACTION} differs from what was executed, though no noise was on"
                findings.damage.append(Damage(place.file, place.episode, int(other[0]), what))
        return int(columns[SCENARIO][0]) >= 0 and len(executed) == place.length


def _no_policy(env: Any) -> Any:
    """Recorded actions need no policy."""
    return None


def _check_same_task(root: Path, metadata: DatasetMetadata, spec: Spec) -> None:
    """Refuses a dataset of another meaning of the task: nothing could be reproduced.

    Raises:
        DatasetError: It was recorded with another version, or the name meant something else.
    """
    now = f"{spec.name}-v{spec.version}"
    if metadata.task_version != spec.version or metadata.task_digest not in (
        "",
        digest(metadata.task),
    ):
        raise DatasetError(
            f"{root} was recorded with {metadata.task}-v{metadata.task_version} "
            f"(digest {metadata.task_digest[:12] or 'unknown'}), this is {now} "
            f"(digest {digest(metadata.task)[:12]}); check it with the hvs-suite that recorded it"
        )


def _check_info(
    info: Mapping[str, Any],
    features: Mapping[str, Mapping[str, Any]],
    spec: Spec,
    places: Iterable[Place],
) -> list[Damage]:
    """Names, shapes, types and counts of ``meta/info.json``."""
    wrong = []
    for name, feature in features.items():
        listed = info["features"].get(name)
        if listed is None:
            wrong.append(f"lacks the feature {name}")
            continue
        for part in ("shape", "names", "dtype"):
            found, wanted = listed.get(part), feature[part]
            if part == "dtype" and wanted == "image" and found == "video":
                continue
            if (list(found) if isinstance(found, list | tuple) else found) != (
                list(wanted) if isinstance(wanted, list | tuple) else wanted
            ):
                wrong.append(f"{part} of {name} is {found}, not {wanted}")
    extra = sorted(set(info["features"]) - set(features) - set(LEROBOT_COLUMNS))
    if extra:
        wrong.append(f"has features of no recording: {', '.join(extra)}")
    expected = {
        "fps": spec.fps,
        "robot_type": ROBOT_TYPE,
        "total_episodes": len(list(places)),
    }
    for name, value in expected.items():
        if info.get(name) != value:
            wrong.append(f"{name} is {info.get(name)}, not {value}")
    return [Damage(reader.INFO, None, None, what) for what in wrong]


def _read_sentences(root: Path, damage: list[Damage]) -> list[str]:
    """What the episodes are about; empty, and damage, where that cannot be read."""
    try:
        return reader.read_sentences(root)
    except DamagedFileError as error:
        damage.append(Damage.of(error))
        return []


def _sentence(env: Any, columns: Mapping[str, npt.NDArray[Any]]) -> str:
    """What was to be done in an episode, by its scenario; empty where that is damaged."""
    scenarios = np.ravel(columns.get(SCENARIO, ()))
    try:
        scene = env.task.source.draw(int(scenarios[0]))
    except (IndexError, ScenarioError):
        return ""
    return str(env.spec.instruction(scene))


def _check_order(places: list[Place]) -> list[Damage]:
    """Episodes are listed one after the other, and so are their frames."""
    damage = []
    start = 0
    for number, place in enumerate(places):
        if place.episode != number:
            what = f"is listed where episode {number} belongs"
            damage.append(Damage(place.listed_in, place.episode, None, what))
            break
        if place.start != start:
            what = f"begins at frame {place.start} of the dataset, not {start}"
            damage.append(Damage(place.listed_in, place.episode, None, what))
        start = place.start + place.length
    return damage


def _check_videos(info: Mapping[str, Any], places: Iterable[Place]) -> list[Damage]:
    """Each episode has a video of what is declared as one, and of nothing else."""
    declared = {name for name, each in info["features"].items() if each["dtype"] == "video"}
    for place in places:
        if wrong := sorted(declared ^ set(place.videos)):
            what = (
                f"{wrong[0]} is {'no ' if wrong[0] in place.videos else ''}video by {reader.INFO}"
            )
            return [Damage(place.listed_in, place.episode, None, what)]
    return []


def _check_files(
    root: Path, places: Iterable[Place], features: Iterable[str]
) -> tuple[set[str], list[Damage]]:
    """Every data file is there and readable, and holds the rows listed and no others.

    Returns:
        Files whose episodes cannot be looked at, and the damage.
    """
    listed: dict[str, list[Place]] = {}
    for place in places:
        listed.setdefault(place.file, []).append(place)
    unreadable: set[str] = set()
    damage = []
    for file, inside in listed.items():
        episodes = [place.episode for place in inside]
        held = f"holds episodes {min(episodes)} to {max(episodes)} and"
        try:
            table = reader.read_table(root, file)
            numbers = reader.column(table, "episode_index")
        except DatasetError as error:
            unreadable.add(file)
            what = error.what if isinstance(error, DamagedFileError) else str(error)
            damage.append(Damage(file, None, None, f"{held} {what}"))
            continue
        stray = set(numbers.ravel().tolist()) - set(episodes)
        for episode in sorted(stray)[:_LISTED_DAMAGE]:
            damage.append(Damage(file, episode, None, "is listed nowhere in this file"))
        wanted = {*features, *LEROBOT_COLUMNS} - set(inside[0].videos)
        lacking = sorted(wanted - set(table.column_names))
        if lacking:
            damage.append(Damage(file, None, None, f"lacks the columns {', '.join(lacking)}"))
    for path in sorted((root / "data").glob("*/*.parquet")):
        name = path.relative_to(root).as_posix()
        if name not in listed:
            damage.append(Damage(name, None, None, "belongs to no episode"))
    return unreadable, damage


def _check_statistics(
    root: Path,
    info: Mapping[str, Any],
    features: Mapping[str, Mapping[str, Any]],
    merged: Mapping[str, list[Moments]],
) -> list[Damage]:
    """Compares the dataset's statistics with those of all its frames."""
    try:
        stats = reader.read_stats(root)
    except DamagedFileError as error:
        return [Damage.of(error)]
    videos = {name for name, feature in info["features"].items() if feature["dtype"] == "video"}
    lacking = [name for name in features if name not in stats]
    damage = [Damage(reader.STATS, None, None, f"lacks {name}") for name in lacking]
    wrong = compare_all(
        {name: merge(each) for name, each in merged.items() if name in stats},
        stats,
        dict.fromkeys(videos, _VIDEO_SLACK),
    )
    return damage + [Damage(reader.STATS, None, None, f"{name}: {w}") for name, w in wrong.items()]


def _order(damage: Damage) -> tuple[int, str, int, str]:
    """Whole files first, then by episode and frame."""
    episode = -1 if damage.episode is None else damage.episode
    return episode, damage.file, -1 if damage.frame is None else damage.frame, damage.what
