"""stream: resumed runs are the uninterrupted one, whatever stopped them, and what is on disk is never lost."""

import errno
import os
import signal
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import vmri_jax as vm
from tests.running.store.conftest import CHUNK, EVERY, STEPS, H, Runs, assert_identical
from tests.support import until_failure
from tests.user_systems import two_oscillators
from vmri_jax.running.simulation import Simulation
from vmri_jax.running.store import layout
from vmri_jax.steppers.solver import Solver

PER_CHUNK = CHUNK * EVERY
IN_FIRST = PER_CHUNK - EVERY
"""Macro steps of the first chunk, which has the start in it."""


@pytest.fixture
def out(tmp_path):
    return tmp_path / "run.zarr"


def stop_after(monkeypatch, chunks: int, where, name: str, error: BaseException) -> None:
    """The call of a function for the chunk after so many raises instead."""
    calls, real = [], getattr(where, name)

    def fails(*arguments, **keywords):
        calls.append(name)
        if len(calls) > chunks:
            raise error
        return real(*arguments, **keywords)

    monkeypatch.setattr(where, name, fails)


def dies_after(monkeypatch, chunks: int, run, out, **changes) -> vm.StoredTrajectory:
    """The store of a run that died with so many chunks."""
    with monkeypatch.context() as patch:
        stop_after(patch, chunks, Simulation, "advance", SystemExit())
        with pytest.raises(SystemExit):
            run(out, **changes)
    return vm.StoredTrajectory(out)


def test_what_is_streamed_is_what_simulate_returns(run, uninterrupted):
    expected = vm.simulate(
        run.problem.system,
        run.scheme,
        run.problem.state(),
        macro_dt=H,
        num_steps=STEPS,
        save=vm.Save(EVERY, micro=True),
    )
    assert_identical(uninterrupted.load(), expected)
    assert uninterrupted.complete
    assert uninterrupted.success
    assert (uninterrupted.step, uninterrupted.num_steps, len(uninterrupted)) == (STEPS, STEPS, 13)


@pytest.mark.parametrize(
    ("where", "name"), [(Simulation, "advance"), (layout.Writer, "write"), (layout, "commit"), (layout, "replaced")]
)
@pytest.mark.parametrize("chunks", [1, 2])
def test_a_run_that_died_goes_on_to_the_last_bit(run, uninterrupted, out, monkeypatch, where, name, chunks):
    """While it computed, wrote a chunk, or was about to commit one."""
    with monkeypatch.context() as patch:
        stop_after(patch, chunks, where, name, SystemExit())
        with pytest.raises(SystemExit):
            run(out)
    died = vm.StoredTrajectory(out)
    assert died.step == IN_FIRST + (chunks - 1) * PER_CHUNK
    (out / "q_f" / "c.1.0.partial").touch()
    assert not died.complete
    assert_identical(died.load(), uninterrupted[: len(died)])
    assert_identical(run(out, resume=True).load(), uninterrupted.load())
    assert not list(out.rglob("*.partial"))


def test_death_before_there_is_a_store(run, uninterrupted, out, monkeypatch):
    with monkeypatch.context() as patch:
        stop_after(patch, 0, layout, "_consolidate", SystemExit())
        with pytest.raises(SystemExit):
            run(out)
    assert list(out.parent.iterdir()) == []
    assert_identical(run(out, resume=True).load(), uninterrupted.load())


def test_the_state_alone_would_not_do(run, uninterrupted):
    """Newton starts from what it learned: without that the run differs in its last digits."""
    begun = uninterrupted[: CHUNK + 1]
    arguments = {"macro_dt": H, "num_steps": STEPS - PER_CHUNK, "save": vm.Save(EVERY, micro=True)}
    rest = vm.simulate(run.problem.system, run.scheme, begun.final_state, **arguments)
    q_f, expected = np.concatenate([begun.q_f, rest.q_f[1:]]), uninterrupted.load().q_f
    assert not np.array_equal(q_f, expected)
    assert np.allclose(q_f, expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("steps", [IN_FIRST, 12])
def test_a_complete_run_is_made_longer(run, uninterrupted, out, steps):
    """At the end of a chunk, and within one."""
    short = run(out, num_steps=steps)
    assert short.complete
    longer = run(out, resume=True)
    assert longer.complete
    assert_identical(longer.load(), uninterrupted.load())
    with pytest.raises(ValueError, match=r"num_steps is 8, but .* has 24 already; open it"):
        run(out, num_steps=8, resume=True)


def test_a_complete_run_is_returned_at_once(run, uninterrupted, monkeypatch):
    monkeypatch.setattr(Simulation, "advance", None)
    assert run(uninterrupted.path, resume=True).complete


def test_a_run_that_has_fallen_back_goes_on_so(tmp_path, monkeypatch):
    """At this step the march does not converge, see test_march."""
    changes = {"scheme": vm.fully_implicit(20), "macro_dt": 40.0, "num_steps": 12, "save": 1}
    run = partial(Runs(two_oscillators(kappa=25.0)), solver=Solver(max_iterations=6), **changes)
    whole, out = run(tmp_path / "whole.zarr").load(), tmp_path / "run.zarr"
    assert np.all(np.asarray(whole.info.method) == vm.Method.EXACT)
    assert dies_after(monkeypatch, 1, run, out).record.fell_back
    assert_identical(run(out, resume=True).load(), whole)


def test_ctrl_c_finishes_the_chunk(run, uninterrupted, out, monkeypatch):
    real, calls = Simulation.advance, []

    def advance(self, at, saves):
        calls.append(saves)
        if len(calls) == 2:
            os.kill(os.getpid(), signal.SIGINT)
        return real(self, at, saves)

    with monkeypatch.context() as patch:
        patch.setattr(Simulation, "advance", advance)
        with pytest.raises(vm.Interrupted, match=r"interrupted after 14 of 24 macro steps") as caught:
            run(out)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    assert isinstance(caught.value, KeyboardInterrupt)
    assert_identical(caught.value.done.load(), uninterrupted[: 2 * CHUNK])
    assert_identical(run(out, resume=True, save=vm.Save(EVERY, micro=True, progress=True)).load(), uninterrupted.load())


def test_a_full_disk_keeps_what_was_written(run, uninterrupted, out, monkeypatch):
    with monkeypatch.context() as patch:
        full = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        stop_after(patch, 1, layout.Writer, "write", full)
        with pytest.raises(OSError, match=r"No space left on device. The run is kept up to macro step 6:") as caught:
            run(out)
    assert caught.value.errno == errno.ENOSPC
    assert_identical(vm.StoredTrajectory(out).load(), uninterrupted[:CHUNK])
    assert_identical(run(out, resume=True).load(), uninterrupted.load())


def test_a_folder_that_cannot_be_written(run, out, monkeypatch):
    denied = PermissionError(errno.EACCES, os.strerror(errno.EACCES))
    stop_after(monkeypatch, 0, layout, "_consolidate", denied)
    with pytest.raises(PermissionError, match=r"run.zarr cannot be written: Permission denied"):
        run(out)
    assert list(out.parent.iterdir()) == []


# --- runs that fail --------------------------------------------------------------------------------------------------
def walled(q_s, q_f, params):
    """A potential that is not a number beyond a wall."""
    return -jnp.sum(jnp.sqrt(1.2 - q_s)) + jnp.sum(q_f**2) / 2


def test_a_failure_is_kept_with_its_status(run, out):
    system = run.problem.system.replace(slow_potential=walled)
    changes = {"system": system, "scheme": vm.fully_explicit(3), "num_steps": 48, "chunk": CHUNK}
    with pytest.raises(vm.SimulationError, match=r"NON_FINITE.* after 0 Newton iterations") as caught:
        run(out, **changes)
    arguments = {"macro_dt": H, "num_steps": 48, "save": vm.Save(EVERY, micro=True)}
    expected = until_failure(system, vm.fully_explicit(3), run.problem.state(), **arguments)
    failed = caught.value.trajectory
    assert isinstance(failed, vm.StoredTrajectory)
    assert failed.failed_at == caught.value.step == int(expected.failed_at) >= PER_CHUNK
    assert caught.value.time == pytest.approx(failed.failed_at * H)
    assert failed.result is vm.Result.NON_FINITE
    assert not failed.success
    assert not failed.complete
    on_disk = failed.load()
    assert len(failed) < 25
    for name in ("q_s", "p_f", "energy", "q_f_micro"):
        array = np.asarray(getattr(on_disk, name))
        assert np.array_equal(array, getattr(expected, name)[: len(array)], equal_nan=True)
    assert int(on_disk.failed_at) == failed.failed_at
    assert failed[:2].success
    with pytest.raises(vm.SimulationError, match="NON_FINITE") as caught:
        run(out, resume=True, **changes)
    assert caught.value.trajectory.failed_at == failed.failed_at


# --- refusals --------------------------------------------------------------------------------------------------------
def steeper(q_s, q_f, params):
    return 2 * jnp.sum(q_f**2)


def same_name(power):
    def steeper(q_f, params):
        return jnp.sum(q_f**power)

    return steeper


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"macro_dt": 0.03}, r"macro_dt: 0.03 here, 0.02 in the store"),
        ({"scheme": vm.fully_explicit(3)}, r"scheme.slow.grid: macro here, micro in the store"),
        ({"solver": Solver(tolerance=1e-10)}, r"solver.tolerance: 1e-10 here, 1e-12 in the store"),
        ({"save": EVERY}, r"save_micro: False here, True in the store"),
        ({"chunk": 5}, r"chunk: 5 here, 4 in the store"),
    ],
)
def test_another_run_is_not_resumed(run, uninterrupted, changes, message):
    with pytest.raises(ValueError, match=rf"uninterrupted.zarr holds another run .*{message}"):
        run(uninterrupted.path, resume=True, **changes)
    assert uninterrupted.load().success


def test_another_system_is_not_resumed(run, uninterrupted, out):
    system, params = run.problem.system, run.problem.system.params
    name = next(iter(params))
    with pytest.raises(ValueError, match=rf"system.params\['{name}'\]: .* here, .* in the store"):
        run(uninterrupted.path, resume=True, system=system.replace(params=params | {name: params[name] * 1.5}))
    with pytest.raises(ValueError, match=r"system.slow_potential: tests.running.store.test_stream.steeper here"):
        run(uninterrupted.path, resume=True, system=system.replace(slow_potential=steeper))
    state = run.problem.state()
    moved = type(state)(state.t, state.q_s + 0.1, state.q_f, state.p_s, state.p_f)
    with pytest.raises(ValueError, match=r"state.q_s: \[.*\] here, \[.*\] in the store"):
        run(uninterrupted.path, resume=True, state=moved)
    with pytest.raises(ValueError, match=r"names\['slow'\]\['centres'\]: 3 here, none in the store"):
        run(uninterrupted.path, resume=True, system=run.problem, state=None)
    short = {"num_steps": PER_CHUNK, "scheme": vm.fully_explicit(3)}
    run(out, system=system.replace(fast_potential=same_name(2)), **short)
    with pytest.raises(ValueError, match=r"Differences: operations of fast_potential: digest \w+ here, digest \w+ in"):
        run(out, resume=True, system=system.replace(fast_potential=same_name(4)), **short)


def test_another_version_is_told(run, out, monkeypatch):
    dies_after(monkeypatch, 1, run, out)
    layout.change_attributes(out, made_with={**vm.StoredTrajectory(out).attributes["made_with"], "jax": "0.1"})
    with pytest.warns(UserWarning, match=r"last digits may differ .*jax .* \(0.1 then\)"):
        run(out, resume=True)


def test_a_checkpoint_of_another_version(run, out, monkeypatch):
    died = dies_after(monkeypatch, 1, run, out)
    layout.commit(out, 0, died.record._replace(leaves=died.record.leaves[:-1]).packed())
    with pytest.raises(ValueError, match=r"can be read, but its run cannot go on: .* remember something else"):
        run(out, resume=True)
    assert_identical(vm.StoredTrajectory(out).load(), died.load())


def test_nothing_is_overwritten_unless_asked(run, uninterrupted, out):
    run(out, num_steps=PER_CHUNK)
    with pytest.raises(FileExistsError, match=r"is a stored run, 2 of 2 chunks done\. Go on with it \(resume=True\)"):
        run(out)
    with pytest.raises(ValueError, match=r"both resume and overwrite"):
        run(out, resume=True, overwrite=True)
    whole = run(out, overwrite=True, chunk=None)
    assert_identical(whole.load(), uninterrupted.load())
    assert whole.chunk == STEPS // EVERY  # a short run is one chunk
    assert [path.name for path in out.parent.iterdir()] == ["run.zarr"]


@pytest.mark.parametrize("asked", [{}, {"resume": True}, {"overwrite": True}])
def test_foreign_things_are_left_alone(run, tmp_path, asked):
    (tmp_path / "file.zarr").write_text("mine")
    folder = tmp_path / "folder.zarr"
    folder.mkdir()
    (folder / "zarr.json").write_text('{"zarr_format": 3, "node_type": "group", "attributes": {}}')
    for path in (tmp_path / "file.zarr", folder):
        with pytest.raises(ValueError, match=rf"{path.name} is not a stored run"):
            run(path, **asked)
    assert (tmp_path / "file.zarr").read_text() == "mine"
    assert [path.name for path in folder.iterdir()] == ["zarr.json"]


def test_two_processes_do_not_write_at_once(run, uninterrupted):
    with (
        layout.locked(uninterrupted.path),
        pytest.raises(BlockingIOError, match=r"is being written by another process; wait for it or stop it"),
    ):
        run(uninterrupted.path, resume=True)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"chunk": 0}, r"chunk is 0; it must be an integer of at least 1"),
        ({"chunk": 2.5}, r"chunk is 2.5"),
        ({"num_steps": 23}, r"not a multiple of save = "),
        ({"out": "nowhere/run.zarr"}, r"out is nowhere/run.zarr, but the folder nowhere does not exist; make it first"),
    ],
)
def test_bad_arguments(run, out, changes, message):
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        run(**({"out": out} | changes))
    with pytest.raises(ValueError, match=r"tracers; call it outside"):
        jax.jit(lambda dt: run(out, macro_dt=dt).load())(0.1)
    assert not out.exists()


def kinetic_energy(q_s, q_f, v_s, v_f, params):
    return jnp.sum((2 + jnp.sin(q_f)) * v_f**2) / 2


def test_a_system_without_numbers(tmp_path):
    """Neither masses nor params: the program of observables gets no array of the system."""
    start = vm.Problem(vm.System(kinetic_energy), [], [0.3], [], [1.0])
    stored = vm.stream(start, vm.fully_implicit(1), macro_dt=0.01, num_steps=4, out=tmp_path / "run.zarr")
    run = vm.simulate(start, vm.fully_implicit(1), macro_dt=0.01, num_steps=4)
    assert np.array_equal(stored.load().energy, run.energy)
