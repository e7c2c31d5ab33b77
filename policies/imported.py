"""Plays a person's own code: ``module:factory``, anything with ``reset`` and ``select_action``.

Importing the module runs its code with all the rights of whoever evaluates it. Nothing in the suite
does so unless that name was typed on the command line or passed to `policy_factory`.
"""

import dataclasses
import importlib
import importlib.util
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from hvs_suite.errors import HvsError, PolicyError, first_line
from hvs_suite.policies.context import PolicyContext
from hvs_suite.rollout import Policy

NAME = re.compile(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*:[A-Za-z_]\w*")


@dataclasses.dataclass(frozen=True)
class ImportedFactory:
    """Builds policies with ``factory(context)``; travels to workers as two names and a folder.

    Attributes:
        module: Importable name.
        factory: Callable in it; takes a `PolicyContext`.
        folder: Searched before the rest of the path: where the command was given.
    """

    module: str
    factory: str
    folder: str

    def __call__(self, env: Any) -> Policy:
        """Builds the policy for an environment.

        Raises:
            PolicyError: The module cannot be imported, its factory raises, or what it makes is no
                policy.
        """
        make, context = self.callable(), PolicyContext.of(env)
        try:
            policy = make(context)
        except HvsError:
            raise
        except Exception as error:  # somebody else's factory raises anything
            raise PolicyError(
                f"{self.module}:{self.factory} raised {type(error).__name__} when it was called "
                f"with a PolicyContext: {first_line(error)}"
            ) from error
        for method in ("reset", "select_action"):
            if not callable(getattr(policy, method, None)):
                raise PolicyError(
                    f"{self.module}:{self.factory} made {type(policy).__name__}, which has no "
                    f"{method}(); a policy has reset() and select_action(observation)"
                )
        return policy

    def callable(self) -> Callable[[PolicyContext], Any]:
        """Imports the module, which runs its code, and returns the factory.

        Raises:
            PolicyError: There is no such module or factory, or importing it fails.
        """
        if self.folder not in sys.path:
            sys.path.insert(0, self.folder)
        try:
            module = importlib.import_module(self.module)
        except (Exception, SystemExit) as error:  # somebody else's module raises anything
            raise PolicyError(
                f"cannot import {self.module}: {type(error).__name__}: {first_line(error)}"
            ) from error
        found = getattr(module, self.factory, None)
        if not callable(found):
            raise PolicyError(f"module {self.module} has no callable {self.factory}")
        return found

    def source(self) -> Path | None:
        """Returns the module's own file, without running it; None if it has none."""
        if self.folder not in sys.path:
            sys.path.insert(0, self.folder)
        try:
            spec = importlib.util.find_spec(self.module)
        except (ImportError, ValueError):
            return None
        return Path(spec.origin) if spec is not None and spec.has_location and spec.origin else None


def imported_factory(spec: str) -> ImportedFactory:
    """Returns the factory behind ``module:factory``, imported once here, before any worker starts.

    Args:
        spec: As typed by the user.

    Raises:
        PolicyError: There is no such module or factory, or importing it fails.
    """
    module, _, name = spec.partition(":")
    factory = ImportedFactory(module, name, str(Path.cwd()))
    factory.callable()
    return factory
