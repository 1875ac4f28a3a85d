"""Lines about work that takes long: on the error stream, unasked, and none about what is short."""

import time

import jax
import numpy as np
import pytest

from vmri_jax.running import progress
from vmri_jax.running.progress import Working, progress_shown


@pytest.fixture
def quick(monkeypatch):
    """Lines after 50 ms instead of 2 s."""
    monkeypatch.setattr(progress, "SECONDS_BETWEEN_LINES", 0.05)
    monkeypatch.setattr(progress, "POLL_SECONDS", 0.01)
    time.sleep(0.6)  # the thread may still sleep for its usual time


def test_long_work_says_what_it_does(quick, capsys):
    with Working("fit") as tell:
        tell("the search", 1, 4)
        with Working("compiling"):
            time.sleep(0.4)
    first, *others = capsys.readouterr().err.splitlines()
    assert first.split() == ["0", "s", "25%", "fit:", "the", "search;", "compiling"]
    assert 1 <= len(others) <= 3  # the same line again comes after 2, 4, 8 times as long


def test_short_work_and_work_under_a_bar_say_nothing(quick, capsys):
    with Working("simulate"):
        pass
    with Working("", shown=False), Working("simulate"):
        time.sleep(0.3)
    assert capsys.readouterr().err == ""


def test_what_has_been_asked_for_is_said_in_a_pipe_without_news(quick, capsys):
    with progress_shown() as tell:
        time.sleep(0.3)
        tell("simulating", 1, 2)
        time.sleep(0.3)
    said = capsys.readouterr().err
    assert said.splitlines()[0].split() == ["0", "s", "starting"]  # words before the first piece of work
    assert "50%  simulating" in said


@pytest.mark.compiles
def test_lines_tell_tracing_and_compiling_from_stepping(quick, capsys):
    def slowly_traced(x):
        time.sleep(0.3)
        return x

    program = jax.jit(slowly_traced)
    with Working("the run", running="stepping"):
        program(np.zeros(2))
        jax.monitoring.record_scalar("/jax/core/compile/backend_compile_duration", 0.0)
        time.sleep(0.2)
        jax.monitoring.record_event_duration_secs("/jax/core/compile/backend_compile_duration", 0.2)
        time.sleep(0.2)
    lines = [line.split("(")[-1] for line in capsys.readouterr().err.splitlines()]
    # a slow machine may step for some milliseconds before the event of compiling
    assert (lines[0], lines[-1], set(lines)) == ("tracing)", "stepping)", {"tracing)", "compiling)", "stepping)"})


@pytest.mark.compiles
def test_a_compiled_program_has_no_stages():
    program, stages = jax.jit(lambda x: x + 1), []
    program(np.zeros(3))
    listener = lambda *event, **_: stages.append(event)  # noqa: E731
    jax.monitoring.register_scalar_listener(listener)
    program(np.zeros(3))
    jax.monitoring.unregister_scalar_listener(listener)
    assert not stages
    assert progress.LONGEST_SILENCE <= 5.0
