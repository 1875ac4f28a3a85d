"""The two errors by which the package refuses a call: an argument that it cannot take, a package that is missing.

The command line shows them as messages; any other ValueError or TypeError is a fault of the package.
"""


class Refused(ValueError, TypeError):
    """An argument, a file or a function of the user is refused; the message says what to change. Caught as ValueError
    or as TypeError."""


class NotInstalled(ImportError):
    """An optional package is missing; the message has the command that installs it."""
