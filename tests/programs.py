"""Which programs tests compile, as `jax.monitoring` tells: nearly all of the time of tests is compiling.

Operations of JAX that a test calls outside of `jax.jit`, such as ``jnp.ones``, are programs of one operation, which
compile in milliseconds; they do not count.
"""

from collections import defaultdict

import jax
import pytest

COMPILED = "/jax/core/compile/backend_compile_duration"
"""The event of `jax.monitoring` for a program that is compiled, or read from the cache on disk."""
OPERATIONS = {name for module in (jax.lax, jax.numpy, jax.numpy.linalg) for name in dir(module)}
"""Names of programs of a single operation; names that start with an underscore are of JAX or of helpers, and small
too."""


class Programs:
    """A plugin of pytest that notes the names of the programs of every test."""

    def __init__(self):
        self.names: dict[str, list[str]] = defaultdict(list)
        self.test = "import of a file"
        jax.monitoring.register_event_duration_secs_listener(self.note)

    def note(self, event: str, duration_secs: float, **about: str | int) -> None:
        """Listen to `jax.monitoring`."""
        name = str(about.get("fun_name", "")).removeprefix("jit_").removeprefix("jit(").removesuffix(")")
        if event == COMPILED and name.replace("-", "_") not in OPERATIONS and not name.startswith("_"):
            self.names[self.test].append(name)

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_runtest_protocol(self, item):
        self.test = item.nodeid
        return (yield)
