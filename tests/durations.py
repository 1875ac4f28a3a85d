"""A plugin of pytest that lists the processor time of tests and files, and with --budget fails a run with one that takes too long.

Processor time is that of the test's process and of the processes that it has waited for. On a machine that does other things
too it is the fairer measure; wall time with two workers is about half of its sum.
"""

import os
import resource
import time
from collections import defaultdict

import pytest

SECONDS_OF_A_TEST = 30.0
"""Most processor time of one test: it is compiling programs, and a developer who runs this test alone waits for it."""
SECONDS_OF_A_FILE = 60.0
"""Most processor time of one file: a worker takes whole files, so a longer one may leave the other worker without work."""
SECONDS_OF_THE_MEASURE = 0.17
"""Processor time of the loop of `slowness` where the budgets were set. A machine that takes longer gets as much more."""
LISTED = 15
"""Rows of the list of the slowest files and of the slowest tests."""


def processor_time() -> float:
    """Seconds of this process, its threads, and its children that have ended."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


def slowness() -> float:
    """Processor time of a loop in Python over that of the machine on which the budgets were set, at least 1."""
    start = time.process_time()
    sum(i * i for i in range(3_000_000))
    return max((time.process_time() - start) / SECONDS_OF_THE_MEASURE, 1.0)


class Durations:
    """Measures where tests run, which is in a worker; sums up and reports where the results come together.

    Args:
        budget: whether a test or a file above its budget fails the run.
    """

    def __init__(self, budget: bool):
        self.budget = budget
        self.slowness = slowness()
        self.start = 0.0
        self.seconds: dict[str, float] = {}
        self.memory = 0.0

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self):
        self.start = processor_time()
        return (yield)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(self):
        report = yield
        if report.when == "teardown":
            peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss  # KiB
            report.user_properties.append(("processor", processor_time() - self.start, peak / 2**20))
        return report

    def pytest_runtest_logreport(self, report):
        for name, *numbers in report.user_properties:
            if report.when == "teardown" and name == "processor":
                self.seconds[report.nodeid], peak = numbers
                self.memory = max(self.memory, peak)

    def files(self) -> dict[str, float]:
        """Processor time of every file."""
        sums = defaultdict(float)
        for test, seconds in self.seconds.items():
            sums[test.split("::")[0]] += seconds
        return sums

    def excesses(self) -> list[str]:
        """A sentence for every test and every file above its budget."""
        limits = (self.seconds, self.slowness * SECONDS_OF_A_TEST), (self.files(), self.slowness * SECONDS_OF_A_FILE)
        return [
            f"{name} took {seconds:.0f} s of processor time; the budget is {limit:.0f} s"
            for durations, limit in limits
            for name, seconds in durations.items()
            if seconds > limit
        ]

    def pytest_sessionfinish(self, session, exitstatus):
        if self.budget and self.excesses() and exitstatus == pytest.ExitCode.OK:
            session.exitstatus = pytest.ExitCode.TESTS_FAILED

    def pytest_terminal_summary(self, terminalreporter):
        if not self.seconds:
            return
        terminalreporter.section("processor time")
        for durations in (self.files(), self.seconds):
            slowest = sorted(durations.items(), key=lambda row: -row[1])[:LISTED]
            lines = [f"{seconds:7.1f} s  {name}\n" for name, seconds in slowest if seconds >= 1.0]
            terminalreporter.write_line("".join(lines))
        total = sum(self.seconds.values())
        terminalreporter.write_line(
            f"{total:7.1f} s  {len(self.seconds)} tests; largest memory of a process: {self.memory:.1f} GiB; this machine takes "
            f"{self.slowness:.1f} times as long as the one where the budgets were set"
        )
        if self.budget:
            for sentence in self.excesses():
                terminalreporter.write_line(f"OVER BUDGET: {sentence}")
