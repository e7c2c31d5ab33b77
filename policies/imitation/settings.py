"""What a training run is a function of, and the fresh policy that it starts with."""

import dataclasses
import math
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from hvs_suite.datasets.features import IMAGES, STATE
from hvs_suite.datasets.metadata import EXPERT
from hvs_suite.errors import DatasetError, OptionError, PolicyError
from hvs_suite.policies.belief.cell_model import cell_model
from hvs_suite.policies.belief.colour_slope import ColourSlopeEye
from hvs_suite.policies.belief.eye import Eye
from hvs_suite.policies.belief.foresight import PAST_STEPS
from hvs_suite.policies.belief.settings import as_numbers, further_keys
from hvs_suite.policies.checkpoints.loading import load_network, weights_digest
from hvs_suite.policies.imitation.dagger import TEACHERS, TeacherName
from hvs_suite.policies.imitation.frame_cache import fingerprint
from hvs_suite.policies.trained_for import trained_for
from hvs_suite.policies.training.dataset import Manifest
from hvs_suite.registry import find
from hvs_suite.tasks.shared.spec import PRESETS

INPUTS = PRESETS["vision"]
PARTS = ("memory", "keypoints")
"""What of the design may be left out."""

if TYPE_CHECKING:
    from hvs_suite.policies.hvs.modeling_hvs import HvsPolicy


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings:
    """All that decides what a run learns, the budget aside.

    Attributes:
        seed: Of initial weights, held-out episodes and order.
        batch_size: Frames a step.
        learning_rate: Peak of the schedule (a short warm-up, then a cosine to zero).
        dagger_rounds: How often to let the policy play, the teacher labelling every step, and to
            add those frames.
        dagger_frames: Frames a round.
        dagger_teacher: Who labels them, see `hvs_suite.policies.imitation.dagger.TEACHERS`.
        dataset: Fingerprint of the dataset.
        task: Named task that it was recorded on.
        inputs: What the policy is given of `INPUTS`, one camera or more; None for all.
        grey: Cameras whose pictures it is given in grey; the dataset's are in colour.
        episodes: Learn from the first so many demonstrations alone; None from all.
        error_scale: See `HvsConfig`.
        eyes: SHA-256 of the weights whose eyes it begins with; none for fresh ones.
        kept_eyes: Cameras whose eyes stay as they were taken.
        weights: SHA-256 of the weights that all of it begins with; None to begin afresh.
        windows: Windows of control steps a step that belief and head learn from.
        window_steps: Length of each.
        eye_share: Part of the training in which the eyes learn, the others from what they see in
            the rest. With 1 there is nothing but eyes, for another run to begin with; with 0 those
            that it begins with learn nothing more.
        slopes: Cameras whose eyes tell the slope of the surface.
        offsets: Cameras whose pose is not exact: how they are shifted and turned is found out.
        without: What to leave out, of `PARTS`, to see what it is good for: ``memory`` of what was
            seen, and ``keypoints``, from which the eyes learn; without them they learn from what
            belief and head make of what they see.
        corrects_within_m: See `hvs_suite.policies.belief.network.Shape`.
    """

    seed: int = 0
    batch_size: int = 64
    learning_rate: float = 2e-3
    dagger_rounds: int = 0
    dagger_frames: int = 6000
    dagger_teacher: TeacherName = "demonstrator"
    dataset: str
    task: str
    inputs: tuple[str, ...] | None = None
    grey: tuple[str, ...] = ()
    episodes: int | None = None
    error_scale: float
    eyes: tuple[str, ...] = ()
    kept_eyes: tuple[str, ...] = ()
    weights: str | None = None
    windows: int = 48
    window_steps: int = 16
    eye_share: float = 0.5
    slopes: tuple[str, ...] = ()
    offsets: tuple[str, ...] = ()
    without: tuple[str, ...] = ()
    corrects_within_m: float | None = None

    def reads(self, name: str) -> bool:
        """Whether the policy is given an input."""
        return self.inputs is None or name in self.inputs

    def check(self, manifest: Manifest) -> None:
        """Refuse numbers that make no sense.

        Args:
            manifest: Of the dataset.

        Raises:
            OptionError: There is one.
        """
        if unknown := sorted({*(self.inputs or ())} - {*INPUTS}):
            raise OptionError(f"unknown input {unknown[0]!r}; choose from {', '.join(INPUTS)}")
        if unknown := sorted({*self.without} - {*PARTS}):
            raise OptionError(f"unknown part {unknown[0]!r}; choose from {', '.join(PARTS)}")
        cameras = [name for name in manifest.cameras if self.reads(name)]
        if unknown := sorted({*self.slopes, *self.offsets, *self.kept_eyes} - {*cameras}):
            raise OptionError(f"unknown camera {unknown[0]!r}; choose from {', '.join(cameras)}")
        if {*self.kept_eyes} == {*cameras}:
            raise OptionError("kept_eyes must leave a camera whose eye learns")
        for name in ("batch_size", "dagger_frames", "windows", "window_steps"):
            if getattr(self, name) < 1:
                raise OptionError(f"{name} must be at least 1, not {getattr(self, name)}")
        if not 0.0 <= self.eye_share <= 1.0:
            raise OptionError(f"eye_share must be from 0 to 1, not {self.eye_share}")
        if self.eyes and self.weights:
            raise OptionError("give --eyes or --weights, which have eyes as well; not both")
        if not (self.eye_share or self.eyes or self.weights):
            raise OptionError("fresh eyes must learn; give --eyes, --weights or an --eye-share")
        if self.eye_share == 1.0 and self.dagger_rounds:
            raise OptionError("eyes alone cannot play; leave --dagger-rounds out, or --eye-share")
        if not 0.0 < self.learning_rate < 1.0:
            raise OptionError(f"learning_rate must be between 0 and 1, not {self.learning_rate}")
        if self.dagger_rounds < 0:
            raise OptionError(f"dagger_rounds must be 0 or more, not {self.dagger_rounds}")
        if self.dagger_teacher not in TEACHERS:
            raise OptionError(
                f"unknown teacher {self.dagger_teacher!r}; choose from {', '.join(TEACHERS)}"
            )
        if (
            self.dagger_rounds
            and self.dagger_teacher == "demonstrator"
            and manifest.demonstrator != EXPERT
        ):
            raise OptionError(
                f"{manifest.root} was recorded with {manifest.demonstrator}, and the demonstrator, "
                "which would label the rounds of DAgger, acts otherwise; leave --dagger-rounds "
                "out, or name another --dagger-teacher"
            )
        if self.episodes is not None and not 1 <= self.episodes <= manifest.n_episodes:
            raise OptionError(
                f"episodes must be 1 to the dataset's {manifest.n_episodes}, not {self.episodes}"
            )
        if self.corrects_within_m is not None and not 0.0 < self.corrects_within_m <= 10.0:
            raise OptionError(
                f"corrects_within_m must be above 0 and at most 10, not {self.corrects_within_m}"
            )
        if not 0.0 < self.error_scale < math.inf:
            raise OptionError(f"error_scale must be above 0, not {self.error_scale}")


def settings_for(
    manifest: Manifest,
    eyes: Sequence[Path],
    weights: Path | None,
    chosen: Mapping[str, Any],
) -> Settings:
    """The settings of a run on a dataset.

    Args:
        manifest: Of the dataset.
        eyes: Checkpoints of policies to take the eyes of; none for fresh ones.
        weights: Checkpoint of the policy to go on with; None for a fresh one.
        chosen: Fields that differ from the defaults; ``error_scale`` is five times the task's
            tightest tolerance (m) where it is None.

    Raises:
        OptionError: A number makes no sense.
    """
    chosen = dict(chosen)
    if chosen.get("error_scale") is None:
        task = find(manifest.task).with_options(manifest.options)
        chosen["error_scale"] = 5e-3 * task.tightest_tolerance_mm
    settings = Settings(
        **chosen,
        dataset=fingerprint(manifest.root),
        task=manifest.task,
        eyes=tuple(weights_digest(folder) for folder in eyes),
        weights=None if weights is None else weights_digest(weights),
    )
    settings.check(manifest)
    return settings


def new_policy(manifest: Manifest, settings: Settings) -> "HvsPolicy":
    """A fresh policy for a dataset's inputs, its belief without a prior.

    Args:
        manifest: Of the dataset, with the inputs that the policy is to have.
        settings: Of the run.

    Raises:
        DatasetError: The policy needs inputs that the dataset does not have.
    """
    from lerobot.configs import FeatureType, PolicyFeature

    from hvs_suite.policies.hvs.configuration_hvs import HvsConfig
    from hvs_suite.policies.hvs.modeling_hvs import HvsPolicy

    task = find(manifest.task).with_options(manifest.options)
    config = HvsConfig(
        input_features=_inputs(manifest),
        output_features={"action": PolicyFeature(FeatureType.ACTION, (7,))},
        device="cpu",
        push_to_hub=False,
        optimizer_lr=settings.learning_rate,
        error_scale=settings.error_scale,
        cell=as_numbers(cell_model(task)),
        window=settings.window_steps,
        reads_positions=settings.reads("joint_positions"),
        reads_velocities=settings.reads("joint_velocities"),
        slopes=settings.slopes,
        slopes_by="colour",
        offsets=settings.offsets,
        foresight=PAST_STEPS if manifest.has_moving_targets else 0,
        remembers="memory" not in settings.without,
        corrects_within_m=settings.corrects_within_m,
        elbow_aside=True,
        **trained_for(task).model_dump(),
    )
    # torch initialises weights from its global generator; leave that as it was found.
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(settings.seed)
        try:
            policy = HvsPolicy(config)
        except ValueError as error:
            raise DatasetError(f"{manifest.root} does not do for hvs: {error}") from error
    for eye in policy.network.eyes.values():
        assert isinstance(eye, Eye)
        eye.train_in_bfloat16 = torch.cpu._is_avx512_bf16_supported()
        if isinstance(eye.slope, ColourSlopeEye):
            eye.slope.judge.train_in_bfloat16 = eye.train_in_bfloat16
    return policy


def _inputs(manifest: Manifest) -> dict[str, Any]:
    """What a policy is given of a dataset, in LeRobot's words."""
    from lerobot.configs import FeatureType, PolicyFeature

    inputs = {
        IMAGES + name: PolicyFeature(FeatureType.VISUAL, (shape[2], shape[0], shape[1]))
        for name, shape in manifest.cameras.items()
    }
    for key in (STATE, *further_keys(manifest.features)):
        if key is not None and key in manifest.features:
            kind = FeatureType.STATE if key == STATE else FeatureType.ENV
            inputs[key] = PolicyFeature(kind, tuple(manifest.features[key]["shape"]))
    return inputs


def take_eyes(policy: "HvsPolicy", folders: Sequence[Path], kept: Collection[str] = ()) -> None:
    """Begin with the eyes of other policies: each camera with those of the first that has it.

    Eyes that found larger targets find smaller ones soon; fresh ones may never get to see a target
    of three pixels (docs/experiments/small-targets.md).

    Args:
        policy: Whose eyes to replace.
        folders: Checkpoints of `hvs` policies.
        kept: Cameras whose eyes are to learn no more.

    Raises:
        PolicyError: One is none, or has no layers that a camera could begin with; or none has all
            that a camera needs which is to learn no more.
    """
    eyes = policy.network.eyes
    fresh = {*eyes}
    for folder in folders:
        others = load_network(folder).eyes
        alike = {name for name in fresh if name in others and _fits(eyes[name], others[name])}
        if not alike:
            raise PolicyError(
                f"{folder} has no eyes that fit {', '.join(sorted(fresh)) or 'what is left'}: "
                "their layers depend on the images' sides and channels"
            )
        for name in alike:
            given = eyes[name].load_state_dict(_layers(others[name], eyes[name]), strict=False)
            if name in kept and given.missing_keys:
                raise PolicyError(f"the eye {name} of {folder} does not tell all it would have to")
        fresh -= alike
    if missing := sorted(fresh & {*kept}):
        raise PolicyError(f"no eyes were given for {missing[0]}, which is to keep them")
    for name in kept:
        eyes[name].requires_grad_(False)


def take_weights(policy: "HvsPolicy", folder: Path, kept: Collection[str] = ()) -> None:
    """Begin with another policy, whole, but for its prior: that is the one of the dataset.

    Args:
        policy: Whose network to replace.
        folder: Checkpoint of an `hvs` policy.
        kept: Cameras whose eyes are to learn no more.

    Raises:
        PolicyError: It is none, or its layers are others.
    """
    network = policy.network
    mine, theirs = network.state_dict(), load_network(folder).state_dict()
    odd = sorted(mine.keys() ^ theirs.keys())
    odd += [name for name in mine if name in theirs and mine[name].shape != theirs[name].shape]
    if odd:
        raise PolicyError(
            f"{folder} has other layers ({odd[0]}) than the policy that was asked for; "
            "give the --inputs, --slopes and --offsets that it was trained with, and a dataset "
            "whose images have the same sides"
        )
    network.load_state_dict(theirs)
    for name in kept:
        network.eyes[name].requires_grad_(False)


def _fits(eye: nn.Module, other: nn.Module) -> bool:
    """Whether all layers that both eyes have are alike; one alone may be told what is meant."""
    mine, theirs = eye.state_dict(), _layers(other, eye)
    common = mine.keys() & theirs.keys()
    return bool(common) and all(mine[name].shape == theirs[name].shape for name in common)


def _layers(other: nn.Module, eye: nn.Module) -> dict[str, Tensor]:
    """The layers of another eye, without those for slopes if this one tells them otherwise."""
    is_alike = type(other.slope) is type(eye.slope)
    return {
        name: value
        for name, value in other.state_dict().items()
        if is_alike or not name.startswith("slope.")
    }
