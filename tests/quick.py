"""`make test-quick`: refusals and structure, tests that compile no program.

Operations of JAX that a test calls outside of `jax.jit`, such as ``jnp.ones``, are programs of one operation, which compile in
milliseconds; they do not count. Any other program that a test compiles fails the run, so that the list stays true.
"""

from collections import defaultdict
from pathlib import Path

import jax
import pytest

FOLDER = Path(__file__).parent
FILES = (
    *("test_arrows.py", "test_bad_input.py", "test_front_door.py", "test_refusals.py"),
    *(f"animation/test_{name}.py" for name in ("drawing", "page")),
    *("cli/test_scene.py", "ensembles/test_design.py", "hard_cases/test_report.py"),
    *(f"running/test_{name}.py" for name in ("arguments", "files", "interrupts", "printed", "progress", "summaries")),
    *(f"scene/test_{name}.py" for name in ("bad_input", "declare", "sorting")),
    *(f"schemes/test_{name}.py" for name in ("path", "plain_data", "quadrature", "scheme")),
)
"""Files whose tests are run with --quick, but for tests with the mark `compiles`."""
COMPILED = "/jax/core/compile/backend_compile_duration"
"""The event of `jax.monitoring` for a compiled program."""
OPERATIONS = {name for module in (jax.lax, jax.numpy, jax.numpy.linalg) for name in dir(module)}
"""Names of programs of a single operation."""


class Quick:
    """Collects the quick tests alone, and fails a run whose tests compile programs."""

    def __init__(self):
        self.programs: dict[str, list[str]] = defaultdict(list)
        self.test = "import of a file"
        jax.monitoring.register_event_duration_secs_listener(self.note)

    def note(self, event: str, duration_secs: float, **about: str | int) -> None:
        """Listen to `jax.monitoring`."""
        name = str(about.get("fun_name", "")).removeprefix("jit_").removeprefix("jit(").removesuffix(")")
        if event == COMPILED and name.replace("-", "_") not in OPERATIONS and not name.startswith("_"):
            self.programs[self.test].append(name)

    def pytest_ignore_collect(self, collection_path: Path):
        is_file = collection_path.name.startswith("test_")
        return True if is_file and collection_path.relative_to(FOLDER).as_posix() not in FILES else None

    def pytest_collection_modifyitems(self, config, items):
        compiling = [item for item in items if item.get_closest_marker("compiles")]
        config.hook.pytest_deselected(items=compiling)
        items[:] = [item for item in items if item not in compiling]

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item):
        self.test = item.nodeid
        return (yield)

    def pytest_sessionfinish(self, session, exitstatus):
        if self.programs and exitstatus == pytest.ExitCode.OK:
            session.exitstatus = pytest.ExitCode.TESTS_FAILED

    def pytest_terminal_summary(self, terminalreporter):
        for test, names in self.programs.items():
            terminalreporter.write_line(f"COMPILES: {test}: {', '.join(names)}; give it the mark `compiles`")
