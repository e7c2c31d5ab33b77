"""A dataset as it comes back from video: the same frames, their pictures decoded, as PNG again.

Training reads lossless datasets. One whose pictures went through a codec and back differs from its
original in nothing but what the codec did.
"""

import dataclasses
import shutil
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa

from hvs_suite.datasets import lerobot_files, reader
from hvs_suite.datasets.demonstration import Demonstration
from hvs_suite.datasets.episode_stats import picture_shades
from hvs_suite.datasets.features import SCENARIO
from hvs_suite.datasets.metadata import METADATA_FILE
from hvs_suite.datasets.png import encode
from hvs_suite.datasets.reader import Picture, Place
from hvs_suite.datasets.writer import DatasetWriter
from hvs_suite.errors import DatasetError

EPISODES_A_BLOCK = 50


@dataclasses.dataclass(frozen=True)
class VideoCopy:
    """A dataset and its copy with videos, episode by episode.

    Attributes:
        data: The lossless dataset.
        video: What :func:`hvs_suite.datasets.publication.convert_to_video` made of it.
    """

    data: Path
    video: Path

    def episodes(self) -> Iterator[tuple[Place, pa.Table, dict[str, list[Picture]]]]:
        """Each episode in order.

        Yields:
            Where it lies in the lossless dataset, its rows there, and image feature to its
            decoded pictures, uint8 (H, W, 3) each.

        Raises:
            DatasetError: The two do not hold the same frames.
        """
        info = reader.read_info(self.video)
        keys = [name for name, each in info["features"].items() if each["dtype"] == "video"]
        copies = {place.episode: place for place in reader.read_places(self.video)}
        for place in sorted(reader.read_places(self.data), key=lambda each: each.episode):
            table = reader.read_episode(self.data, place)
            copy = copies.get(place.episode)
            if copy is None or copy.length != place.length:
                raise DatasetError(f"{self.video} lacks episode {place.episode}, or part of it")
            pictures = {}
            for key in keys:
                decoded = reader.decode_video(self.video, info, copy, key)
                if len(decoded) != place.length:
                    raise DatasetError(
                        f"{self.video}: episode {place.episode}: {key} has {len(decoded)} frames, "
                        f"not {place.length}"
                    )
                pictures[key] = decoded
            yield place, table, pictures

    def write_decoded(self, out: Path, on_episode: Callable[[], None] | None = None) -> None:
        """Writes the lossless dataset again with the decoded pictures, as PNG.

        Args:
            out: Folder to make; replaced if it exists.
            on_episode: Called after each episode.

        Raises:
            DatasetError: The two do not hold the same frames.
        """
        shutil.rmtree(out, ignore_errors=True)
        out.mkdir(parents=True)
        shutil.copy(self.data / METADATA_FILE, out / METADATA_FILE)
        info = reader.read_info(self.data)
        counters = lerobot_files.with_counters({})
        features = {k: v for k, v in info["features"].items() if k not in counters}
        sentences = reader.read_sentences(self.data)
        writer = DatasetWriter(out, features, info["fps"], EPISODES_A_BLOCK)
        for _, table, pictures in self.episodes():
            writer.save(_demonstration(features, table, pictures, sentences))
            if on_episode is not None:
                on_episode()
        writer.publish()


def _demonstration(
    features: dict[str, Any],
    table: pa.Table,
    pictures: dict[str, list[Picture]],
    sentences: Sequence[str],
) -> Demonstration:
    """An episode's own numbers with other pictures."""
    numbers = {
        name: reader.column(table, name).astype(feature["dtype"])
        for name, feature in features.items()
        if name not in pictures
    }
    images: dict[str, list[bytes]] = {name: encode(each) for name, each in pictures.items()}
    return Demonstration(
        scenario=int(numbers[SCENARIO].ravel()[0]),
        length=table.num_rows,
        columns={**numbers, **images},
        shades=picture_shades(pictures),
        task=sentences[int(reader.column(table, "task_index")[0])],
        success=bool(numbers["next.success"].any()),
        collision=False,
    )
