"""Plays code of one's own: ``module:factory``, anything with ``reset`` and ``select_action``.

How to write such a module: docs/your-policy.md.

Importing the module runs its code with all the rights of the user. The suite does so only if that
name was typed on the command line or passed to `policy_factory`; a score is played in a separate
process (see `hvs_suite.eval.serving.policy_process`).
"""

import dataclasses
import importlib
import re
import sys
from collections.abc import Callable, Sequence
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from typing import Any

from hvs_suite.errors import PolicyError, describe
from hvs_suite.policies.context import PolicyContext
from hvs_suite.rollout import Policy

NAME = re.compile(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*:[A-Za-z_]\w*")


@dataclasses.dataclass(frozen=True)
class ImportedFactory:
    """Builds policies with ``factory(context)``; travels to other processes as three texts.

    Attributes:
        module: Importable name.
        factory: Callable in it; takes a `PolicyContext`.
        place: Folder that is searched before the rest of the path: where the command was given.
        knows_truth: Give the factory the environment itself in place of a `PolicyContext`: for
            demonstrators, which may know what is true.
    """

    module: str
    factory: str
    place: str
    knows_truth: bool = False

    def __call__(self, env: Any) -> Policy:
        """Imports the module, which runs its code, and builds the policy for an environment.

        Raises:
            PolicyError: The module cannot be imported, its factory raises, or what it makes is no
                policy.
        """
        name = f"{self.module}:{self.factory}"
        make = self._callable()
        try:
            policy: Any = make(env if self.knows_truth else PolicyContext.of(env))
        except PolicyError:
            raise
        except (Exception, SystemExit) as error:  # foreign code may raise anything
            raise PolicyError(
                f"{name} cannot be built ({describe(error)}); a factory takes one "
                f"{'Environment' if self.knows_truth else 'PolicyContext'}"
            ) from error
        for method in ("reset", "select_action"):
            if not callable(getattr(policy, method, None)):
                raise PolicyError(
                    f"{name} made {type(policy).__name__}, which has no "
                    f"{method}(); a policy has reset() and select_action(observation)"
                )
        return policy

    def source(self) -> Path | None:
        """Returns the module's own file, without running anything; None if it has none.

        Raises:
            PolicyError: There is no such module.
        """
        # `importlib.util.find_spec` would run the packages around the module.
        package, _, rest = self.module.partition(".")
        spec = PathFinder.find_spec(package, [self.place]) or _find(package, None)
        for part in rest.split(".") if rest else ():
            if spec is None or spec.submodule_search_locations is None:
                spec = None
                break
            spec = _find(f"{spec.name}.{part}", spec.submodule_search_locations)
        if spec is None:
            raise PolicyError(f"cannot import {self.module}: there is no module of this name")
        return Path(spec.origin) if spec.has_location and spec.origin else None

    def _callable(self) -> Callable[[Any], Any]:
        if self.place not in sys.path:
            sys.path.insert(0, self.place)
        try:
            module = importlib.import_module(self.module)
        except (Exception, SystemExit) as error:  # a foreign module may raise anything
            raise PolicyError(f"cannot import {self.module}: {describe(error)}") from error
        found = getattr(module, self.factory, None)
        if not callable(found):
            raise PolicyError(f"module {self.module} has no callable {self.factory}")
        return found


def _find(name: str, path: Sequence[str] | None) -> ModuleSpec | None:
    """Asks each of Python's finders where a module lies, as an import does."""
    found = (finder.find_spec(name, path) for finder in sys.meta_path)
    return next((spec for spec in found if spec is not None), None)


def imported_factory(spec: str) -> ImportedFactory:
    """Returns the factory behind ``module:factory``, of which nothing has run yet.

    Args:
        spec: As typed by the user.
    """
    module, _, name = spec.partition(":")
    return ImportedFactory(module, name, str(Path.cwd()))
