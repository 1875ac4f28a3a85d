"""`make test-quick`: refusals and structure, tests that compile no program.

A program that a test compiles, see `tests/programs.py`, fails the run, so that the list stays true.
"""

from pathlib import Path

import pytest

from tests.programs import Programs

FOLDER = Path(__file__).parent
FILES = (
    *("test_arrows.py", "test_bad_input.py", "test_front_door.py", "test_refusals.py"),
    *(f"animation/test_{name}.py" for name in ("drawing", "page")),
    *("ensembles/test_design.py", "hard_cases/test_report.py"),
    *(f"running/test_{name}.py" for name in ("arguments", "files", "interrupts", "printed", "progress", "summaries")),
    *(f"scene/test_{name}.py" for name in ("bad_input", "declare", "sorting")),
    *(f"schemes/test_{name}.py" for name in ("path", "plain_data", "quadrature", "scheme")),
)
"""Files whose tests are run with --quick, but for tests with the mark `compiles`."""


class Quick:
    """Collects the quick tests alone, and fails a run whose tests compile programs."""

    def __init__(self, programs: Programs):
        self.programs = programs

    def pytest_ignore_collect(self, collection_path: Path):
        is_file = collection_path.name.startswith("test_")
        return True if is_file and collection_path.relative_to(FOLDER).as_posix() not in FILES else None

    def pytest_collection_modifyitems(self, config, items):
        compiling = [item for item in items if item.get_closest_marker("compiles")]
        config.hook.pytest_deselected(items=compiling)
        items[:] = [item for item in items if item not in compiling]

    def pytest_sessionfinish(self, session, exitstatus):
        if self.programs.names and exitstatus == pytest.ExitCode.OK:
            session.exitstatus = pytest.ExitCode.TESTS_FAILED

    def pytest_terminal_summary(self, terminalreporter):
        for test, names in self.programs.names.items():
            terminalreporter.write_line(f"COMPILES: {test}: {', '.join(names)}; give it the mark `compiles`")
