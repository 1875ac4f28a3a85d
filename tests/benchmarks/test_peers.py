"""The peers integrate the very problems that ours integrate; those whose package is absent are skipped."""

import json
import time
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from typer.testing import CliRunner

import benchmarks.__main__ as command_line
import vmri_jax as vm
from benchmarks import c_loops
from benchmarks.peers import autodiff, cases, compare, equations, mechanics, ours
from benchmarks.peers.cases import Ladder, NotRepresentable
from benchmarks.peers.scan import Point, candidates, front, scan

SHORT = ("FPU l=3 t=1", "TSP t=1", "SAM t=1")
PAIRS = [(peer, name) for name in SHORT for peer in compare.PEERS if name != SHORT[0] or peer not in compare.OF_RODS]
pytestmark = pytest.mark.filterwarnings("ignore")  # the peers' own


def module(peer: str):
    """Of a peer; the test is skipped where it cannot run."""
    if peer == "C by hand" and c_loops.compiler() is None:
        pytest.skip("no C compiler (cc, gcc or clang) on the PATH")
    pytest.importorskip(f"benchmarks.peers.{compare.PEERS[peer]}")
    return compare.load(peer)


def climb(ladder: Ladder, case: cases.Case) -> list[float]:
    """Errors of every fourth setting, until one is below 1e-5 or a run takes a while."""
    errors = []
    for setting in ladder.settings[::4]:
        (point,) = scan("", [replace(ladder, settings=[setting])], case.error, 1.0)
        errors.append(point.error)
        if point.error < 1e-5 or point.seconds > 0.1:
            break
    return errors


# --- the same problem ------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("peer", "name"), PAIRS)
def test_energy_at_the_start(peer, name):
    found, case = module(peer), cases.case(name)
    assert compare.energy_difference(found, case) < 1e-10  # measured 4e-16


@pytest.mark.parametrize(("peer", "name"), [pair for pair in PAIRS if pair[1] in SHORT[:2]])
def test_errors_fall(peer, name):
    """Along the last ladders of a peer, to errors that only the same problem can give."""
    found, case = module(peer), cases.case(name)
    for ladder in found.ladders(case)[-1 if name == "TSP t=1" else -2 :]:
        errors = climb(ladder, case)
        last = errors[-3:]
        assert all(b < a for a, b in pairwise(last)), (ladder.method, errors)
        assert errors[-1] < 1e-3


@pytest.mark.parametrize("given", [equations, autodiff])
@pytest.mark.parametrize("name", SHORT)
def test_accelerations(name, given):
    """Those written by hand, and those by autodiff, are those of the system, with the multipliers of ``G M^-1 G^T``."""
    case = cases.case(name)
    system, n_s = case.problem.system, case.state.q_s.size
    slow, fast = system.slow_potential, system.fast_potential
    assert slow is not None
    assert fast is not None

    def potential(q):
        return slow(q[:n_s], q[n_s:], system.params) + fast(q[n_s:], system.params)

    def constraints(q):
        return system.constraints(0.0, q[:n_s], q[n_s:])

    def curvature(q, v):
        return jax.jvp(lambda q: jax.jvp(constraints, (q,), (v,))[1], (q,), (v,))[1]

    q, v = jnp.asarray(case.q + 0.1 * np.random.default_rng(0).normal(size=case.q.size)), jnp.asarray(case.v)
    free, g = -jax.grad(potential)(q) / case.masses, jax.jacrev(constraints)(q)
    mu = jnp.linalg.solve((g / case.masses) @ g.T, -curvature(q, v) - g @ free) if g.shape[0] else jnp.zeros(0)
    expected = free + g.T @ mu / case.masses
    assert np.abs(jax.jit(given.acceleration(case))(q, v) - expected).max() < 1e-11 * np.abs(expected).max()


def test_chain_of_any_length():
    """The array form, for long chains, is the one over single numbers."""
    case = cases.case("FPU l=200 t=1")
    q = np.random.default_rng(0).normal(size=400)
    long = np.asarray(equations.acceleration(case)(jnp.asarray(q), None))
    assert np.abs(long - np.array(mechanics.chain_accelerations(list(q), case.omega))).max() < 1e-11
    assert np.abs(mechanics.from_masses(mechanics.to_masses(q)) - q).max() < 1e-14


def test_elimination():
    matrix = [[4.0, None, 1.0], [None, 3.0, 2.0], [1.0, 2.0, 5.0]]
    dense = np.array([[x or 0.0 for x in row] for row in matrix])
    right = [1.0, 2.0, 3.0]
    assert np.allclose(mechanics.solve(matrix, right), np.linalg.solve(dense, right), rtol=1e-14)


@pytest.mark.parametrize("name", cases.NAMES)
def test_references(name):
    case = cases.case(name)
    assert case.q_end.shape == case.q.shape
    assert case.error(case.q_end) == 0
    assert np.isnan(case.error(np.full(case.q.size, np.nan)))
    assert name.startswith(case.system)


def test_unknown_case():
    with pytest.raises(ValueError, match="there is no 'FPU l=4 t=1'; there are FPU l=3 t=1"):
        cases.case("FPU l=4 t=1")


def test_without_a_compiler(monkeypatch):
    monkeypatch.setattr(c_loops, "compiler", lambda: None)
    size = compare.Size(SHORT[:1], ("C by hand",), 1.0, 1, 1)
    (report,) = compare.run(size, "quick")
    assert report.notes == [
        "FPU l=3 t=1: C by hand was left out: there is no C compiler (cc, gcc or clang) on the PATH."
    ]


# --- scan ------------------------------------------------------------------------------------------------------------
def from_zero(end) -> float:
    """The error of a case whose solution is 0."""
    return float(np.abs(end[0]))


def test_scan():
    """Levels are reached where no finer setting misses them; a ladder ends when it is fine enough, and is finer where
    it reaches one."""
    errors = {1: np.nan, 2: 1e-5, 4: 1e-3, 8: 1e-6, 16: 1e-10, 32: 1e-12}
    between = {5: 1e-3, 6: 2e-6, 11: 1e-6, 13: 1e-9}
    ladder = Ladder("method", "steps", list(errors), lambda n: lambda: np.array([(errors | between)[n]]))
    points = {p.label: p for p in scan("one", [ladder], from_zero, 1.0)}
    assert [points[f"method, {n} steps"].settled for n in between] == list(between.values())
    assert [points[f"method, {n} steps"].settled for n in (1, 2, 4, 8, 16)] == [np.inf, 1e-3, 1e-3, 1e-6, 1e-10]
    assert "method, 32 steps" not in points


def test_scan_of_an_integrator_that_gives_up():
    def run():
        raise RuntimeError("too large a step")

    (point,) = scan("one", [Ladder("method", "tol", [1e-3], lambda tol: run)], from_zero, 1.0)
    assert point.error == np.inf
    assert point.label == "method, 1.0e-03"


def point(error: float, seconds: float) -> Point:
    return Point("one", f"{error}", error, error, seconds, 0.0, 0.0, lambda: None)


def test_candidates_and_front():
    points = [point(1e-3, 1.0), point(1e-5, 1.2), point(1e-4, 2.0), point(1e-9, 4.0)]
    assert [p.seconds for p in candidates(points, 1e-2)] == [1.0, 1.2]
    assert [p.seconds for p in candidates(points, 1e-8)] == [4.0]
    assert candidates(points, 1e-12) == []
    assert [p.seconds for p in front(points)] == [1.0, 1.2, 4.0]


# --- the command -----------------------------------------------------------------------------------------------------
def test_sizes():
    size = compare.sizes("full", only=["TSP"], peers=["heyoka"])
    assert size.cases == ("TSP t=1", "TSP t=10")
    assert size.peers == ("vmri_jax", "heyoka")
    with pytest.raises(ValueError, match="there is no case LJ"):
        compare.sizes("quick", only=["LJ"])
    with pytest.raises(ValueError, match="there is no lammps"):
        compare.sizes("quick", peers=["lammps"])


def test_command(tmp_path, monkeypatch):
    """With ours, one that is absent, one that cannot, and one that is slower and coarse."""

    def slow(case):
        def run():
            end = time.process_time() + 0.01
            while time.process_time() < end:  # a process that sleeps takes no processor time
                pass
            return case.q_end + 1e-3

        return [Ladder("slow", "steps", [1, 2], lambda n: run)]

    def absent(case):
        raise ModuleNotFoundError(name="nowhere")

    def cannot(case):
        raise NotRepresentable("it knows no springs")

    def energy(case):
        return case.energy

    modules = {
        "vmri_jax": ours,
        "OpenMM": SimpleNamespace(ladders=slow, energy=energy),
        "scipy": SimpleNamespace(ladders=absent, energy=energy),
        "heyoka": SimpleNamespace(ladders=cannot, energy=energy),
    }
    monkeypatch.setattr(ours, "schemes", lambda case: {"one": vm.compose(vm.fully_explicit(2), "kahan-li8")})
    monkeypatch.setattr(compare, "load", modules.__getitem__)
    size = compare.Size(("FPU l=3 t=1",), tuple(modules), 1.0, 2, 2)
    monkeypatch.setattr(command_line.peers, "sizes", lambda name, **_: size)
    monkeypatch.setattr(command_line, "prepare", lambda *_, **__: None)  # the tests have started JAX already
    told = []
    run = command_line.peers.run
    monkeypatch.setattr(command_line.peers, "run", lambda size, name, tell: run(size, name, told.append))
    done = CliRunner().invoke(command_line.app, ["peers", "--out", str(tmp_path), "--only", "FPU"])
    assert done.exit_code == 0, done.exception
    assert len(told) == 4 + 1  # peers and timing

    found = json.loads((tmp_path / "peers.json").read_text())
    rows = {(row["case"], row["peer"]): row for row in found["rows"]}
    assert set(rows) == {("FPU l=3 t=1", "vmri_jax"), ("FPU l=3 t=1", "OpenMM")}
    assert [level["level"] for level in rows["FPU l=3 t=1", "vmri_jax"]["levels"]] == list(cases.LEVELS)
    assert rows["FPU l=3 t=1", "OpenMM"]["1e-08"] == "not reached"
    assert {claim["what"] for claim in found["claims"]} == {"FPU l=3 t=1, 1e-02: OpenMM over ours"}
    assert found["claims"][0]["seen"]["value"] > 3
    notes = " ".join(found["notes"])
    assert "scipy was left out: there is no nowhere; pip install" in notes
    assert "heyoka was left out: it knows no springs" in notes
    assert "OpenMM does not reach 2e-04 or 2e-06 or 1e-08: its best is" in notes
    assert {path.name for path in tmp_path.iterdir()} == {"peers.json", "peers_fpu.png"}
