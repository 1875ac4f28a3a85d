"""The errors by which the package refuses a call, for an argument that it cannot take or a package that is missing, and
its warnings.

The command line shows refusals as messages; any other ValueError or TypeError is a fault of the package.
"""

import sys
import warnings


class Refused(ValueError, TypeError):
    """An argument, a file or a function of the user is refused; the message says what to change. Caught as ValueError
    or as TypeError."""


class NotInstalled(ImportError):
    """An optional package is missing; the message has the command that installs it."""


def warn_user(message: str | Warning, category: type[Warning] = UserWarning) -> None:
    """Warn at the line of the user: the innermost one that is neither in the package nor in a library that calls it."""
    level, frame = 2, sys._getframe(1)
    while frame.f_back and frame.f_globals.get("__name__", "").partition(".")[0] in ("vmri_jax", "jax", "equinox"):
        level, frame = level + 1, frame.f_back
    warnings.warn(message, category, stacklevel=level)
