"""The figures of a compression study, and how well a detector finds the target in pictures."""

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import pydantic

from hvs_suite import statistics
from hvs_suite.datasets.reader import Picture
from hvs_suite.tasks.shared.detection import find_disc

FloatArray = npt.NDArray[np.float64]


class _Block(pydantic.BaseModel):
    model_config = pydantic.ConfigDict(extra="forbid", frozen=True)


class Spread(_Block):
    """The middle and the bad end of lengths (px).

    Attributes:
        median: Half of them are below.
        p95: 95 % of them are below.
    """

    median: float
    p95: float

    @classmethod
    def of(cls, lengths: FloatArray) -> "Spread | None":
        """Of lengths (n,); None of none."""
        if not len(lengths):
            return None
        return cls(
            median=statistics.percentile(lengths, 50), p95=statistics.percentile(lengths, 95)
        )


class CameraFigures(_Block):
    """What became of one camera's pictures.

    Attributes:
        megabytes: Size of a thousand of them (MB).
        psnr_db: Peak signal-to-noise ratio against lossless over all of them (dB); None of the
            lossless ones themselves.
        n: Pictures that show the whole target, its centre in line of sight.
        pc_found: Percentage of those in which the detector's answer lies on the target.
        error_px: Distance of that answer from the target's true projected centre (px).
        moved_px: Distance of that answer from the one in the lossless picture (px).
    """

    megabytes: float
    psnr_db: float | None
    n: int
    pc_found: float
    error_px: Spread | None
    moved_px: Spread | None


class Success(_Block):
    """How a policy that learned from the decoded pictures does on live scenarios.

    Attributes:
        n: Scenarios.
        n_success: Solved.
        pc_success_ci95: Wilson's interval (percent).
        n_only_lossless: Solved only by the policy that learned from lossless pictures.
        n_only_this: Solved only by this one.
        p: Two-sided p-value of McNemar's exact test against the lossless one.
        errors: Mean of each metric over all episodes, where they were scored.
        settled_error: Interquartile mean of the task's first headline metric at the time limit.
    """

    n: int
    n_success: int
    pc_success_ci95: tuple[float, float]
    n_only_lossless: int
    n_only_this: int
    p: float
    errors: dict[str, float]
    settled_error: float


class Row(_Block):
    """One setting; the first of a study is lossless PNG.

    Attributes:
        codec: As shown: AV1, H.264 or PNG.
        crf: Constant rate factor; None for PNG.
        pixel_format: FFmpeg's name; None for PNG.
        cameras: Figures by camera.
        success: None where no policy was trained.
    """

    codec: str
    crf: int | None
    pixel_format: str | None
    cameras: dict[str, CameraFigures]
    success: Success | None = None

    @property
    def megabytes(self) -> float:
        """Size of a thousand frames, all cameras together (MB)."""
        return math.fsum(each.megabytes for each in self.cameras.values())


class Study(_Block):
    """A whole study.

    Attributes:
        task: Named task.
        frames: Frames of the dataset; each holds a picture of every camera.
        episodes: Episodes of the dataset.
        resolutions: Side of each camera's pictures (px).
        steps: Optimiser steps of each policy; 0 if none was trained.
        rows: Lossless first, then the settings in the order asked for.
    """

    task: str
    frames: int
    episodes: int
    resolutions: dict[str, int]
    steps: int
    rows: list[Row]


class Answers:
    """What the detector says of one camera's pictures, against the truth.

    Args:
        truth: ``privileged.target_<camera>`` (n, 4).
        centres: The detector's answers (n, 2) px, NaN where it has none.
        side: Of the pictures (px).
    """

    def __init__(self, truth: FloatArray, centres: FloatArray, side: int) -> None:
        self.truth = truth
        self.centres = centres
        place, diameter, visible = truth[:, :2], truth[:, 2], truth[:, 3]
        # In units of half a picture, in which the disc's radius is its diameter in whole pictures.
        self.whole = (visible > 0) & (np.abs(place).max(axis=1) + diameter <= 1.0)
        true_px = (place + 1.0) / 2.0 * side - 0.5
        self.error = np.hypot(*(centres - true_px).T)
        # A pixel more: the smallest discs are a few pixels wide.
        self.found = self.whole & (self.error <= 0.5 * diameter * side + 1.0)

    def figures(
        self, megabytes: float, psnr_db: float | None, reference: "Answers | None"
    ) -> CameraFigures:
        """The figures, against the answers in lossless pictures where there are other ones."""
        moved = None
        if reference is not None:
            both = self.found & reference.found
            moved = Spread.of(np.hypot(*(self.centres - reference.centres)[both].T))
        n = int(self.whole.sum())
        return CameraFigures(
            megabytes=megabytes,
            psnr_db=psnr_db,
            n=n,
            pc_found=100.0 * int(self.found.sum()) / max(1, n),
            error_px=Spread.of(self.error[self.found]),
            moved_px=moved,
        )


def located(pictures: Sequence[Picture]) -> FloatArray:
    """Asks the detector for the target.

    Args:
        pictures: uint8 (H, W, 3) each.

    Returns:
        Its answers (n, 2) px, NaN where it has none.
    """
    discs = [find_disc(picture) for picture in pictures]
    nothing = np.full(2, np.nan)
    return np.array([nothing if disc is None else disc.centre for disc in discs])
