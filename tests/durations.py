"""A plugin of pytest that lists programs and processor time of tests and files, and with --budget fails a run of too
many programs.

A number of programs is the same on every machine, and compiling them is nearly all of the time. Processor time is that
of the test's process and of the processes that it has waited for; wall time with two workers is about half of its sum.
"""

import os
import resource
import time
from collections import defaultdict

import pytest

from tests.programs import Programs

PROGRAMS_OF_A_TEST = 20
"""Most programs of one test; a developer who runs this test alone waits for them."""
PROGRAMS_OF_A_FILE = 70
"""Most programs of one file: a worker takes whole files, so a longer one may leave the other worker without work."""
SECONDS_OF_THE_MEASURE = 0.17
"""Processor time of the loop of `slowness` on the machine of reference: two idle cores of 2025."""
LISTED = 15
"""Rows of the list of the slowest files and of the slowest tests."""


def processor_time() -> float:
    """Seconds of this process, its threads, and its children that have ended."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


def slowness() -> float:
    """Processor time of a loop in Python over that of the machine of reference."""
    start = time.process_time()
    sum(i * i for i in range(3_000_000))
    return (time.process_time() - start) / SECONDS_OF_THE_MEASURE


class Durations:
    """Measures where tests run, which is in a worker; sums up and reports where the results come together.

    Args:
        programs: of the tests of this process.
        budget: whether a test or a file above its budget fails the run.
    """

    def __init__(self, programs: Programs, budget: bool):
        self.programs = programs
        self.budget = budget
        self.start = 0.0
        self.costs: dict[str, tuple[float, int]] = {}
        self.memory = 0.0

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self):
        self.start = processor_time()
        return (yield)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(self, item):
        report = yield
        if report.when == "teardown":
            peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss  # KiB
            count = len(self.programs.names.get(item.nodeid, ()))
            report.user_properties.append(("cost", processor_time() - self.start, count, peak / 2**20))
        return report

    def pytest_runtest_logreport(self, report):
        for name, *numbers in report.user_properties:
            if report.when == "teardown" and name == "cost":
                seconds, count, peak = numbers
                self.costs[report.nodeid] = seconds, count
                self.memory = max(self.memory, peak)

    def files(self) -> dict[str, tuple[float, int]]:
        """Processor time and programs of every file."""
        sums: dict[str, tuple[float, int]] = defaultdict(lambda: (0.0, 0))
        for test, (seconds, count) in self.costs.items():
            file = test.split("::")[0]
            sums[file] = sums[file][0] + seconds, sums[file][1] + count
        return sums

    def excesses(self) -> list[str]:
        """A sentence for every test and every file above its budget."""
        limits = (self.costs, PROGRAMS_OF_A_TEST), (self.files(), PROGRAMS_OF_A_FILE)
        return [
            f"{name} compiled {count} programs; the budget is {limit}"
            for costs, limit in limits
            for name, (_, count) in costs.items()
            if count > limit
        ]

    def pytest_sessionfinish(self, session, exitstatus):
        if self.budget and self.excesses() and exitstatus == pytest.ExitCode.OK:
            session.exitstatus = pytest.ExitCode.TESTS_FAILED

    def pytest_terminal_summary(self, terminalreporter):
        if not self.costs:
            return
        terminalreporter.section("processor time and programs")
        for costs in (self.files(), self.costs):
            slowest = sorted(costs.items(), key=lambda row: -row[1][0])[:LISTED]
            lines = [f"{seconds:7.1f} s {count:4d}  {name}\n" for name, (seconds, count) in slowest if seconds >= 1.0]
            terminalreporter.write_line("".join(lines))
        seconds, count = (sum(cost[k] for cost in self.costs.values()) for k in range(2))
        terminalreporter.write_line(
            f"{seconds:7.1f} s {count:4d} programs of {len(self.costs)} tests; largest memory of a process: "
            f"{self.memory:.1f} GiB; this machine takes {slowness():.1f} times as long as the machine of reference"
        )
        if self.budget:
            for sentence in self.excesses():
                terminalreporter.write_line(f"OVER BUDGET: {sentence}")
