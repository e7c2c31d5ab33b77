"""Checkpoints on the Hugging Face Hub: ``owner/name``, or ``owner/name@revision``.

The Hub's own client does the work: it keeps what it fetched, works offline from there
(``HF_HUB_OFFLINE=1``), and lets ``HF_ENDPOINT`` name another server. Only settings and weights are
fetched. Settings may name code, see `hvs_suite.policies.checkpoints.files`, which refuses those.
"""

import contextlib
import functools
import re
from collections.abc import Collection
from pathlib import Path

from hvs_suite.errors import PolicyError

_WORD = r"[A-Za-z0-9][\w.-]*"
NAME = re.compile(rf"({_WORD}/{_WORD})(?:@(\S+))?")
FILES = ("*.json", "*.safetensors")


def fetch(spec: str) -> Path:
    """Returns the folder that holds a checkpoint of the Hub, fetched if it is not there yet.

    Args:
        spec: As `NAME` matches it.

    Raises:
        PolicyError: It does not exist, or the Hub cannot be reached.
    """
    found = NAME.fullmatch(spec)
    if found is None:
        raise PolicyError(f"{spec!r} is no Hub id; one looks like owner/name or owner/name@v1")
    try:
        import huggingface_hub
        from huggingface_hub import errors
    except ImportError as error:
        raise PolicyError(f"fetching {spec} needs LeRobot; install hvs-suite[learn]") from error
    name, revision = found.groups()
    fetch_files = functools.partial(
        huggingface_hub.snapshot_download, name, revision=revision, allow_patterns=list(FILES)
    )
    try:
        return Path(fetch_files())
    except (errors.RepositoryNotFoundError, errors.RevisionNotFoundError) as error:
        raise PolicyError(
            f"{spec!r} is neither a folder here nor a public checkpoint of the Hub; check the name"
        ) from error
    except Exception as error:  # the client lets its transport's errors through
        # Asked for a commit, the client goes to the Hub even for what it has.
        with contextlib.suppress(errors.LocalEntryNotFoundError):
            return Path(fetch_files(local_files_only=True))
        raise PolicyError(
            f"{spec!r} is no folder here and was never fetched, and the Hub cannot be reached; "
            "check the name, go online, or name a checkpoint folder"
        ) from error


def push(folder: Path, repository: str, files: Collection[str], *, private: bool) -> None:
    """Push files of a checkpoint to the Hub, whose client finds the token by itself.

    Args:
        folder: The checkpoint.
        repository: ``user/name``; made if it is not there.
        files: What to push, relative to the folder.
        private: Make the repository private.

    Raises:
        OptionError: The repository's name is malformed.
        ServerError: The Hub cannot be reached or refuses.
    """
    from huggingface_hub import HfApi

    from hvs_suite.datasets.publication import check_repository, hub_errors

    check_repository(repository)
    with hub_errors(repository):
        api = HfApi()
        api.create_repo(repository, private=private, exist_ok=True)
        api.upload_folder(
            repo_id=repository,
            folder_path=folder,
            allow_patterns=list(files),
            commit_message="Upload policy",
        )
