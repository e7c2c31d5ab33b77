"""``hvs share``: a dataset with its card, as one archive or on the Hugging Face Hub."""

import contextlib
import dataclasses
import re
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Literal

import tyro

from hvs_suite.cli import console
from hvs_suite.errors import DatasetError, OptionError

# As the Hub writes them; it stands in the card's front matter.
_LICENCE = re.compile(r"[A-Za-z0-9][A-Za-z0-9.+-]{0,63}")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Share:
    """Share a dataset: write its card, then pack it or push it to the Hugging Face Hub.

    The dataset is checked first (pictures are decoded but not drawn again), and a damaged one is
    refused. The Hub's token is taken from HF_TOKEN or an earlier login; it is neither printed nor
    stored.

    Attributes:
        data: Root folder of the dataset; the card goes into it as README.md.
        to_archive: Archive to write (.tar or .tar.gz), with checksums; the same dataset gives the
            same bytes.
        to_hub: Repository to push to, user/name.
        private: Make the repository private.
        video: Share a copy whose images are videos: much smaller, and lossy.
        codec: Encoder of the videos.
        crf: Constant rate factor of the videos; lower is better and larger.
        pixel_format: yuv420p keeps a colour for four pixels, as LeRobot has it; yuv444p one for
            each, without which small targets are lost (docs/experiments/compression.md), with h264.
        licence: Identifier of the dataset's licence.
        workers: Processes that check.
    """

    data: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="DIR")]
    to_archive: Path | None = None
    to_hub: str | None = None
    private: bool = False
    video: bool = False
    codec: Literal["libsvtav1", "h264"] = "libsvtav1"
    crf: int = 30
    pixel_format: Literal["yuv420p", "yuv444p"] = "yuv420p"
    licence: str = "apache-2.0"
    workers: int = 1

    def run(self) -> None:
        """Check, describe, convert if asked, and hand over."""
        from hvs_suite.datasets import archive, card, publication
        from hvs_suite.files import check_writable

        if self.to_archive is None and self.to_hub is None:
            raise OptionError("say where to: --to-archive FILE or --to-hub user/name")
        if self.to_archive is not None:
            archive.check_suffix(self.to_archive)
            check_writable(self.to_archive)
        if self.to_hub is not None:
            publication.check_repository(self.to_hub)
        if not _LICENCE.fullmatch(self.licence):
            raise OptionError(f"{self.licence!r} names no licence; write one such as apache-2.0")
        if not 0 <= self.crf <= 63:
            raise OptionError(f"crf is {self.crf}; use 0 (best) to 63")
        self._refuse_damage(self.data)
        with self._shared() as root:
            text = card.write_card(root, self.licence)
            if self.to_archive is not None:
                checksum = archive.pack(root, self.to_archive)
                print(f"wrote {self.to_archive}, sha256 {checksum}")
            if self.to_hub is not None:
                publication.push(root, self.to_hub, text, self.licence, private=self.private)
                print(f"pushed to {self.to_hub}")

    @contextlib.contextmanager
    def _shared(self) -> Iterator[Path]:
        """The dataset to share: itself, or a copy with videos that is gone afterwards."""
        if not self.video:
            yield self.data
            return
        from hvs_suite.datasets.publication import Encoding, convert_to_video

        with tempfile.TemporaryDirectory(prefix="hvs-share-") as folder:
            out = Path(folder) / self.data.resolve().name
            convert_to_video(self.data, out, Encoding(self.codec, self.crf, self.pixel_format))
            self._refuse_damage(out)
            yield out

    def _refuse_damage(self, root: Path) -> None:
        from hvs_suite.datasets.check import check_dataset

        with console.meter() as update:
            report = check_dataset(
                root,
                workers=self.workers,
                pictures=False,
                progress=lambda done, total: update(
                    "checking", done / total, f"{done}/{total} episodes"
                ),
            )
        if report.damage:
            raise DatasetError(
                f"{root} is damaged in {len(report.damage)} places, first {report.damage[0]}; see "
                "'hvs check'"
            )
