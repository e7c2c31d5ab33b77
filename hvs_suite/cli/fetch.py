"""``hvs fetch``: unpack a shared archive, every file checked."""

import dataclasses
from pathlib import Path
from typing import Annotated

import tyro


@dataclasses.dataclass(frozen=True, kw_only=True)
class Fetch:
    """Unpack an archive of 'hvs share' into a new folder, and check every file's checksum.

    An archive with anything but plain files below the folder is refused, and nothing is written.

    Attributes:
        archive: Archive to unpack (.tar or .tar.gz).
        out: Folder to make; must not exist or be empty.
        sha256: Checksum that the archive must have, as 'hvs share' printed it.
    """

    archive: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="ARCHIVE")]
    out: Path
    sha256: str | None = None

    def run(self) -> None:
        """Unpack, and say what came."""
        from hvs_suite.datasets.archive import unpack

        count, metadata = unpack(self.archive, self.out, self.sha256)
        print(f"{self.out}: {count} files of {metadata.task}, checksums match")
