"""What the files of a checkpoint may hold; all of them are checked before any of them is loaded.

A checkpoint may come from other people. LeRobot imports and calls whatever a processor step names
under ``class``, and some of its own steps and policies fetch a tokenizer or a network from the Hub
and run code that comes with it. So the suite accepts only policies and steps that are made from the
folder's numbers alone, by classes that LeRobot knows by name. Any other policy plays as
``module:factory`` (see `hvs_suite.policies.imported`), with which the user agrees to run its code.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import pydantic

from hvs_suite.errors import PolicyError, first_line
from hvs_suite.reading import check_regular, read_object, tensor_shapes, validated

if TYPE_CHECKING:
    from torch import nn

CONFIG = "config.json"
WEIGHTS = "model.safetensors"
PREPROCESSOR = "policy_preprocessor.json"
POSTPROCESSOR = "policy_postprocessor.json"
FILES = (CONFIG, WEIGHTS, PREPROCESSOR, POSTPROCESSOR)

POLICIES = ("hvs", "act", "diffusion", "tdmpc", "vqbet")
"""LeRobot's names of the policies whose weights are all in the checkpoint."""
STEPS = (
    "rename_observations_processor",
    "to_batch_processor",
    "device_processor",
    "normalizer_processor",
    "unnormalizer_processor",
)
"""LeRobot's registered names of the steps that compute with numbers and do nothing else."""

MOST_SETTINGS_BYTES = 4 * 2**20
"""A thousand times the settings of any checkpoint of ours."""
MOST_WEIGHTS_BYTES = 4 * 2**30
"""A thousand million numbers; our own networks hold a quarter of a million."""
MOST_SIZE = 4096
"""Largest width, depth or side of a network or its inputs."""
MOST_STEPS = 1_000_000
"""Largest count of steps among a policy's settings."""

Size = Annotated[int, pydantic.Field(strict=True, ge=1, le=MOST_SIZE)]


class _Settings(pydantic.BaseModel):
    model_config = pydantic.ConfigDict(extra="allow", strict=True)


class _Feature(_Settings):
    type: str
    shape: Annotated[list[Size], pydantic.Field(min_length=1, max_length=4)]


Features = Annotated[dict[str, _Feature], pydantic.Field(min_length=1, max_length=64)]


class _Config(_Settings):
    type: str
    input_features: Features
    output_features: Features

    @pydantic.field_validator("type")
    @classmethod
    def _is_known(cls, value: str) -> str:
        if value not in POLICIES:
            raise ValueError(
                f"policies of type {value[:80]!r} are not played from a folder, only "
                f"{', '.join(POLICIES)}; write a module:factory for others"
            )
        return value


class Step(pydantic.BaseModel):
    """One step of a processor.

    Attributes:
        registry_name: One of `STEPS`.
        config: Its arguments.
        state_file: File of the checkpoint that holds its numbers; None if it has none.
    """

    model_config = pydantic.ConfigDict(extra="forbid", strict=True)

    registry_name: str
    config: dict[str, Any] = {}
    state_file: str | None = None

    @pydantic.model_validator(mode="before")
    @classmethod
    def _names_no_code(cls, content: Any) -> Any:
        if isinstance(content, dict) and "class" in content:
            raise ValueError(
                f"'class' names code to import ({str(content['class'])[:80]!r}), which a "
                "checkpoint must not; only LeRobot's registered steps are run"
            )
        return content

    @pydantic.field_validator("registry_name")
    @classmethod
    def _is_known(cls, value: str) -> str:
        if value not in STEPS:
            raise ValueError(
                f"step {value[:80]!r} is not run, only {', '.join(STEPS)}; write a module:factory "
                "for a policy that needs others"
            )
        return value

    @pydantic.field_validator("state_file")
    @classmethod
    def _is_plain(cls, value: str | None) -> str | None:
        if value is not None and Path(value).with_suffix(".safetensors").name != value:
            raise ValueError(f"{value[:80]!r} is no name of a safetensors file of this folder")
        return value


class _Processor(_Settings):
    steps: list[Step]


def read_config(folder: Path) -> dict[str, Any]:
    """Check all files of a LeRobot checkpoint, and read its ``config.json``.

    To be called before a checkpoint is loaded.

    Args:
        folder: The checkpoint.

    Returns:
        The parsed file: ``type`` is one of `POLICIES`; ``input_features`` and ``output_features``
        map names to ``{"type", "shape"}``, each shape of 1 to 4 whole numbers above 0.

    Raises:
        PolicyError: The folder is not such a checkpoint, holds something else than ordinary files
            of bounded size, or names code or further downloads.
    """
    for name in FILES:
        if not (folder / name).exists():
            raise PolicyError(f"{folder} is not a LeRobot checkpoint: it has no {name}")
    check_files(folder)
    config = _read(folder, CONFIG)
    validated(_Config, config, folder / CONFIG, error=PolicyError)
    for name in (PREPROCESSOR, POSTPROCESSOR):
        for step in read_steps(folder, name):
            if step.state_file is not None:
                read_shapes(folder, step.state_file)
    read_shapes(folder)
    return config


def check_files(folder: Path) -> None:
    """Check that settings and weights of a folder are ordinary files of bounded size.

    Args:
        folder: Any checkpoint.

    Raises:
        PolicyError: One is a FIFO, a device or a folder, leads out of the folder, or is too large.
    """
    for suffix, most in ((".json", MOST_SETTINGS_BYTES), (".safetensors", MOST_WEIGHTS_BYTES)):
        for path in sorted(folder.glob(f"*{suffix}")):
            check_regular(path, error=PolicyError, within=home(folder, path.name), most=most)


def read_steps(folder: Path, name: str) -> list[Step]:
    """Read the steps of a processor.

    Args:
        folder: The checkpoint.
        name: `PREPROCESSOR` or `POSTPROCESSOR`.

    Raises:
        PolicyError: The file is damaged, or has a step that is not taken.
    """
    content = _read(folder, name)
    return validated(_Processor, content, folder / name, error=PolicyError).steps


def read_settings[Model: pydantic.BaseModel](model: type[Model], folder: Path) -> Model:
    """Read a checkpoint's ``config.json`` as one kind of policy has it.

    Args:
        model: What is to be in it.
        folder: The checkpoint.

    Raises:
        PolicyError: It is not that.
    """
    return validated(model, _read(folder, CONFIG), folder / CONFIG, error=PolicyError)


def read_shapes(folder: Path, name: str = WEIGHTS) -> dict[str, tuple[int, ...]]:
    """Read the shapes of a file of weights, by the names of its tensors.

    Args:
        folder: The checkpoint.
        name: The file.

    Raises:
        PolicyError: It is damaged.
    """
    return tensor_shapes(
        folder / name, most=MOST_WEIGHTS_BYTES, error=PolicyError, within=home(folder, name)
    )


def check_sizes(folder: Path, settings: Mapping[str, Any]) -> None:
    """Check that no setting of a policy asks for more than any of these policies needs.

    Args:
        folder: The checkpoint, for the message.
        settings: By name, as the policy's own class has parsed them.

    Raises:
        PolicyError: A whole number is negative, or beyond `MOST_SIZE` (`MOST_STEPS` for steps).
    """
    for name, value in settings.items():
        most = MOST_STEPS if name.endswith("steps") else MOST_SIZE
        for number in value if isinstance(value, list | tuple) else [value]:
            if isinstance(number, int) and not 0 <= number <= most:
                raise PolicyError(f"{folder / CONFIG}: {name} must be 0 to {most:,}, not {number}")


def check_weights(folder: Path, make: Callable[[], "nn.Module"], prefix: str = "") -> None:
    """Check, before any memory is taken for it, that a network is the one whose weights are there.

    Settings may ask for a network of any size; the weights beside them are no larger than their
    file.

    Args:
        folder: The checkpoint.
        make: Makes the network; called where tensors take no memory.
        prefix: Of its weights' names in the file.

    Raises:
        PolicyError: The network cannot be made, or its weights are not those of the file.
    """
    import torch

    try:
        # Some layers draw their weights even there; leave torch's generator as it was.
        with torch.random.fork_rng(devices=[]), torch.device("meta"):
            network = make()
    except Exception as error:  # torch and LeRobot raise anything at sizes that make no sense
        raise PolicyError(
            f"{folder}: {CONFIG} describes no network ({first_line(error)})"
        ) from error
    expected = {prefix + name: tuple(value.shape) for name, value in network.state_dict().items()}
    found = read_shapes(folder)
    for name in sorted(expected.keys() | found.keys()):
        if expected.get(name) != found.get(name):
            raise PolicyError(
                f"{folder} cannot be loaded: {name} is {_said(found, name)} in {WEIGHTS}, and "
                f"{_said(expected, name)} after {CONFIG}"
            )


def _said(shapes: Mapping[str, tuple[int, ...]], name: str) -> str:
    return f"of shape {shapes[name]}" if name in shapes else "missing"


def _read(folder: Path, name: str) -> dict[str, Any]:
    return read_object(
        folder / name, error=PolicyError, within=home(folder, name), most=MOST_SETTINGS_BYTES
    )


def home(folder: Path, name: str) -> Path:
    """Where a file of a checkpoint has to lie: in its folder, or where the Hub's cache keeps it.

    Args:
        folder: The checkpoint.
        name: The file, relative to it.
    """
    place = folder.resolve()
    if place.parent.name == "snapshots" and (folder / name).is_symlink():
        return place.parent.with_name("blobs")
    return place
