"""Finds policies by name: baselines, shipped weights, a checkpoint here or on the Hub, own code."""

import dataclasses
import difflib
import os
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

from hvs_suite.errors import PolicyError
from hvs_suite.policies import imported
from hvs_suite.policies.checkpoints import files, hub
from hvs_suite.policies.recipe import trained_on
from hvs_suite.registry import announced, find
from hvs_suite.rollout import PolicyFactory
from hvs_suite.tasks.shared.spec import Spec

BUILTIN = ("expert", "servo", "push", "zero", "random")
SHIPPED = ("pretrained", "finetuned")
NAMES = (*BUILTIN, *SHIPPED)
HERE = Path(__file__).resolve().parent
LAST_CHECKPOINT = "checkpoints/last/pretrained_model"
"""Where lerobot-train leaves the policy, below its output folder."""
AS_NAMED: Mapping[str, Any] = MappingProxyType({})


def policy_factory(spec: str, task: str, options: Mapping[str, Any] = AS_NAMED) -> PolicyFactory:
    """Find a policy for a task.

    Args:
        spec: ``expert``, ``servo``, ``push``, ``zero``, ``random``, ``pretrained``, ``finetuned``
            (the weights shipped for the task), a checkpoint folder, a checkpoint's Hub id
            (``owner/name``), or ``module:factory`` for code of one's own, which is imported and run
            once the policy is built (see `hvs_suite.policies.imported`).
        task: Named task.
        options: Options that it is played with, where they differ from it.

    Returns:
        Builds the policy for an environment; pickles, so that workers can build their own.

    Raises:
        PolicyError: There is no such policy, it cannot be loaded, or it does not fit the task.
        UnknownTaskError: There is no such task.
        OptionError: An option does not exist or its value makes no sense.
    """
    played = announced(find(task).with_options(options))
    if spec in BUILTIN:
        return _builtin(spec)
    if imported.NAME.fullmatch(spec):
        return imported.imported_factory(spec)
    return _checkpoint(checkpoint_folder(spec, task), played)


def demonstrator_factory(
    spec: str, task: str, options: Mapping[str, Any] = AS_NAMED
) -> PolicyFactory:
    """Find a policy that demonstrates a task, which may know what is true.

    Args:
        spec: As in `policy_factory`; the factory of ``module:factory`` is called with the
            environment itself.
        task: Named task.
        options: Options that it is played with, where they differ from it.

    Returns:
        Builds the policy for an environment; pickles.

    Raises:
        HvsError: As `policy_factory`.
    """
    make = policy_factory(spec, task, options)
    if isinstance(make, imported.ImportedFactory):
        return dataclasses.replace(make, knows_truth=True)
    return make


def shipped_folder(kind: str, task: str) -> Path:
    """Where the weights are that ship for a task, if any do.

    Imitated weights also serve tasks that ask nothing else. Fine-tuned ones serve the task alone on
    which they are shown to be better than these.

    Args:
        kind: ``pretrained`` or ``finetuned``.
        task: Named task.
    """
    return HERE / kind / (trained_on(task) if kind == "pretrained" else task)


def checkpoint_folder(spec: str, task: str) -> Path:
    """Find a checkpoint for a task.

    Args:
        spec: ``pretrained`` or ``finetuned``, a folder, or a Hub id, which is fetched.
        task: Named task.

    Raises:
        PolicyError: There is no such checkpoint.
    """
    if spec in SHIPPED:
        folder = shipped_folder(spec, task)
        if not folder.is_dir():
            command = "hvs pretrain" if spec == "pretrained" else "hvs finetune"
            raise PolicyError(
                f"this version ships no {spec} weights for {task}; train your own with {command}"
            )
        return folder
    # Unlike pathlib's, this is just False for a name that cannot be.
    if os.path.isdir(spec):
        if os.path.isdir(last := os.path.join(spec, LAST_CHECKPOINT)):
            raise PolicyError(f"{spec} is a run of lerobot-train; name its policy, {last}")
        return Path(spec)
    if hub.NAME.fullmatch(spec):
        return hub.fetch(spec)
    if spec in files.POLICIES:
        raise PolicyError(
            f"{spec} is a type of policy, not a trained one; name the folder of one, such as "
            f"RUN/{LAST_CHECKPOINT} after lerobot-train"
        )
    close = difflib.get_close_matches(spec, NAMES, n=1)
    hint = (
        f"did you mean {close[0]}?"
        if close
        else f"use {', '.join(NAMES)}, a folder, a Hub id such as owner/name, or module:factory"
    )
    raise PolicyError(f"{spec!r} is neither a policy nor a checkpoint folder; {hint}")


def name_of(folder: Path) -> str:
    """A checkpoint's folder as notes name it: shipped weights without this machine's path.

    Args:
        folder: As `checkpoint_folder` gives it.

    Returns:
        Such as ``pretrained/align-thesis``, or the folder as it is.
    """
    place = folder.resolve()
    return place.relative_to(HERE).as_posix() if place.is_relative_to(HERE) else str(folder)


def _builtin(name: str) -> PolicyFactory:
    if name == "expert":
        from hvs_suite.datasets.expert import make_expert

        return make_expert
    if name == "servo":
        from hvs_suite.policies.servo import make_servo

        return make_servo
    if name == "push":
        from hvs_suite.policies.servo import make_push

        return make_push
    from hvs_suite.policies import builtin

    return builtin.make_zero if name == "zero" else builtin.make_random


def _checkpoint(folder: Path, task: Spec) -> PolicyFactory:
    """Check a checkpoint here and now, before workers are started for it."""
    try:
        from hvs_suite.policies.checkpoints import loading
        from hvs_suite.policies.sac import playing
    except ImportError as error:
        raise PolicyError(f"playing {folder} needs torch; install hvs-suite[learn]") from error
    if playing.is_sac(folder):
        playing.check_fit(playing.read_config(folder), folder, task)
        return playing.SacFactory(str(folder.resolve()))
    loading.check_fit(files.read_config(folder), folder, task)
    return loading.CheckpointFactory(str(folder.resolve()))
