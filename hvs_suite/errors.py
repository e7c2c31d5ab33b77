"""Typed errors: every wrong input ends in one of these, with one clear line.

The command line prints the line and exits with 2; libraries can catch the class they expect. Each
class also derives from the built-in that Python users would expect.
"""


class HvsError(Exception):
    """Base of every error that the suite raises for bad input; its text says how to correct it."""


class UnknownTaskError(HvsError, LookupError):
    """A task name that is not registered; the text offers the nearest names."""


class OptionError(HvsError, ValueError):
    """An option that does not exist or whose value makes no sense."""


class LockError(HvsError, ValueError):
    """A task that is not in the version lock, or means something else than the lock says."""


class ActionError(HvsError, ValueError):
    """An action with NaN, infinity, a wrong shape, or values outside [-1, 1]."""


class ScenarioError(HvsError, ValueError):
    """A scenario index or split that does not exist."""


class RenderError(HvsError, RuntimeError):
    """No OpenGL backend can render; ``hvs doctor`` names the missing system package."""


class OutputError(HvsError, OSError):
    """A file or folder that cannot be written, or must not be overwritten."""


class DatasetError(HvsError, ValueError):
    """A dataset that cannot be used for what was asked."""


class PolicyError(HvsError, ValueError):
    """A policy that does not exist, cannot be loaded, or does not fit the task."""


class TrainingError(PolicyError):
    """A training whose loss or gradient is no number any more."""


class ResultError(HvsError, ValueError):
    """An evaluation result that is malformed, duplicate or inconsistent."""


class ServerError(HvsError, ConnectionError):
    """A policy server that cannot be reached, breaks off, or speaks another protocol."""


class ClusterError(HvsError, RuntimeError):
    """A Ray cluster that cannot be joined, or whose machines have other packages than this one."""


def describe(error: BaseException) -> str:
    """Returns the name and the text of an error, even of one whose own text raises.

    Args:
        error: The error, possibly of code outside the suite.
    """
    name, text = type(error).__name__, first_line(error)
    return name if text == name else f"{name}: {text}"


def first_line(error: BaseException) -> str:
    """The message of an exception of code outside the suite, as one line.

    Args:
        error: The exception; its message may be empty, or computing it may raise.

    Returns:
        The first line of its text, or its type's name.
    """
    try:
        lines = str(error).splitlines()
    except Exception:  # any __str__ may raise anything
        lines = []
    return lines[0] if lines else type(error).__name__
