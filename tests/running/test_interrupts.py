"""Ctrl-C in runs with a progress bar."""

import os
import pickle
import signal
import threading

import numpy as np
import pytest

from vmri_jax import Interrupted, Save, fully_explicit, simulate
from vmri_jax.running.interrupts import interrupts_noted
from vmri_jax.running.simulation import Simulation


def interrupt():
    os.kill(os.getpid(), signal.SIGINT)


def test_the_first_is_noted_the_second_raises():
    with interrupts_noted() as interrupted:
        assert not interrupted()
        interrupt()
        assert interrupted()
        with pytest.raises(KeyboardInterrupt):
            interrupt()
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_handlers_of_others_stay_and_other_threads_run():
    def own(number, frame):
        seen.append(number)

    def work():
        with interrupts_noted() as interrupted:
            found.append(interrupted())

    seen, found, before = [], [], signal.signal(signal.SIGINT, own)
    try:
        with interrupts_noted() as interrupted:
            interrupt()
            assert seen
            assert not interrupted()
    finally:
        signal.signal(signal.SIGINT, before)
    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert found == [False]


@pytest.mark.compiles
def test_a_run_hands_back_what_was_computed(fpu, monkeypatch):
    real, calls = Simulation.advance, []

    def advance(self, at, saves):
        calls.append(saves)
        if len(calls) == 3:
            interrupt()
        return real(self, at, saves)

    arguments = {"macro_dt": 0.01, "num_steps": 100}
    expected = simulate(fpu.system, fully_explicit(3), fpu.state(), **arguments)
    monkeypatch.setattr(Simulation, "advance", advance)
    with pytest.raises(Interrupted, match=r"interrupted after 6 of 100 macro steps") as caught:
        simulate(fpu.system, fully_explicit(3), fpu.state(), save=Save(progress=True), **arguments)
    found = caught.value.done
    assert found.success
    assert np.array_equal(found.q_f, expected.q_f[:7])
    again = pickle.loads(pickle.dumps(caught.value))
    assert (again.number, again.total, str(again)) == (6, 100, str(caught.value))
