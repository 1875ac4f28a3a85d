"""Hand-written C loops, the speed floor of the three systems and of molecules with all pairs, compiled when first
used."""

import ctypes
import dataclasses
import functools
import getpass
import hashlib
import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from vmri_jax import Problem
from vmri_jax.mechanics.surroundings import innermost
from vmri_jax.systems.fermi_pasta_ulam import soft_springs
from vmri_jax.systems.simple_atomic_model import slow_forces
from vmri_jax.systems.triple_spherical_pendulum import spring

SOURCES = Path(__file__).parent / "c"
FLAGS = ("-O3", "-march=native", "-fno-math-errno", "-shared", "-fPIC")
"""No -ffast-math: the same arithmetic as XLA's. -fno-math-errno only lets sqrt be one instruction."""

_ARRAY, _REAL, _LONG = np.ctypeslib.ndpointer(np.float64, flags="C_CONTIGUOUS"), ctypes.c_double, ctypes.c_long
SIGNATURES = {
    "fpu": (_ARRAY, _ARRAY, _LONG, _REAL, _LONG, _REAL, _LONG),
    "molecules": (_ARRAY, _ARRAY, _LONG, _REAL, _REAL, _LONG, _REAL, _LONG),
    "tsp": (_ARRAY, _ARRAY, _ARRAY, _ARRAY, _REAL, _REAL, _REAL, _LONG, _REAL),
    "sam": (_ARRAY, _ARRAY, _ARRAY, _ARRAY, _REAL, _REAL, _REAL, _LONG, _REAL),
}


class NoCompiler(RuntimeError):
    """There is no C compiler on this machine."""


def compiler() -> str | None:
    """Path of the system's C compiler, the first of cc, gcc and clang, or None."""
    return next(filter(None, map(shutil.which, ("cc", "gcc", "clang"))), None)


def missing() -> list[str]:
    """A note for reports where there is no compiler."""
    if compiler() is not None:
        return []
    return ["No C compiler (cc, gcc or clang) on the PATH: nothing was held against C. Install one for that."]


@dataclasses.dataclass(frozen=True)
class CLoop:
    """A C loop and its data; call it to run from the initial data: (q_s, q_f, p_s, p_f) at the end."""

    function: Callable[..., int]
    q: np.ndarray
    p: np.ndarray
    num_slow: int
    arguments: tuple

    def __call__(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        return self.run()[0]

    def run(self):
        """``((q_s, q_f, p_s, p_f), iterations)``: also the Newton iterations of all steps together."""
        q, p, n = self.q.copy(), self.p.copy(), self.num_slow
        iterations = self.function(q, p, *self.arguments)
        if iterations < 0:
            raise RuntimeError(
                "CLoop: the loop gave up. Newton's iteration did not reach the tolerance in 50 iterations (it may be "
                "below the round-off of the constraints, or the step too large), or there was no memory for the chain."
            )
        return (q[:n], q[n:], p[:n], p[n:]), iterations


def fpu(problem: Problem, num_micro: int, micro_dt: float, num_macro_steps: int) -> CLoop:
    """`fully_explicit(num_micro)` on a `fermi_pasta_ulam` chain of unit masses: the impulse method."""
    kinetic: Any = problem.system.kinetic
    unit = np.all(np.concatenate([kinetic.slow, kinetic.fast]) == 1.0)
    _check("fpu", problem.system.slow_potential if unit else None, soft_springs, num_micro, num_macro_steps)
    omega = float(problem.system.params["omega"])
    return _loop("fpu", problem, len(problem.q_s), omega, num_micro, micro_dt, num_macro_steps)


def molecules(
    problem: Problem, length: float, stiffness: float, num_micro: int, micro_dt: float, num_macro_steps: int
) -> CLoop:
    """`fully_explicit(num_micro)` on diatomic molecules with Lennard-Jones forces between all pairs: the impulse
    method.

    Args:
        problem: fast coordinates alone, atom by atom, unit masses, as of `benchmarks.dear.systems.molecules`; its
            potentials are not looked at.
        length, stiffness: of the bonds.
        num_micro, micro_dt, num_macro_steps: the steps.
    """
    if min(num_micro, num_macro_steps) < 1:
        raise ValueError(f"molecules: numbers of steps are {(num_micro, num_macro_steps)}; they must be at least 1.")
    return _loop("molecules", problem, len(problem.q_f) // 6, stiffness, length, num_micro, micro_dt, num_macro_steps)


def tsp(problem: Problem, micro_dt: float, num_steps: int, tolerance: float = 1e-12) -> CLoop:
    """RATTLE, `fully_explicit(1)`, on a `triple_spherical_pendulum`, constraints below the tolerance."""
    _check("tsp", problem.system.fast_potential, spring, num_steps)
    return _rattle("tsp", problem, ("lengths", "stiffness", "gravity"), micro_dt, num_steps, tolerance)


def sam(problem: Problem, micro_dt: float, num_steps: int, tolerance: float = 1e-12) -> CLoop:
    """RATTLE, `fully_explicit(1)`, on a `simple_atomic_model`; arguments and errors as for `tsp`."""
    _check("sam", problem.system.slow_potential, slow_forces, num_steps)
    return _rattle("sam", problem, ("stiffness", "length", "gravity"), micro_dt, num_steps, tolerance)


def _rattle(name: str, problem: Problem, parameters, *arguments) -> CLoop:
    params = {key: np.asarray(value, dtype=float) for key, value in problem.system.params.items()}
    values = (params[key] if params[key].ndim else float(params[key]) for key in parameters)
    return _loop(name, problem, params["masses"], *values, *arguments)


def _check(name: str, potential, function, *counts: int) -> None:
    if innermost(potential) is not function:
        raise ValueError(f"{name}: the C loop knows only the built-in system of this name, with its own potentials.")
    if min(counts) < 1:
        raise ValueError(f"{name}: numbers of steps are {counts}; they must be at least 1.")


def _loop(name: str, problem: Problem, *arguments) -> CLoop:
    function = getattr(_library(name), name)
    function.restype, function.argtypes = ctypes.c_long, SIGNATURES[name]
    state = problem.state()
    q, p = np.concatenate([state.q_s, state.q_f]), np.concatenate([state.p_s, state.p_f])
    return CLoop(function, q, p, len(state.q_s), arguments)


def c_loop(system: str, problem: Problem, num_micro: int, micro_dt: float, num_steps: int) -> CLoop:
    """The C loop over `num_steps` macro steps: the impulse method, or RATTLE with every step a micro step."""
    if system.startswith("FPU"):
        return fpu(problem, num_micro, micro_dt, num_steps)
    return {"TSP": tsp, "SAM": sam}[system](problem, micro_dt, num_steps * num_micro)


@functools.cache
def _library(name: str) -> ctypes.CDLL:
    """The compiled source, from a folder outside the repository that is keyed by sources, compiler and flags."""
    cc = compiler()
    if cc is None:
        raise NoCompiler("c_loops: no C compiler (cc, gcc or clang) on the PATH; install one to measure the C loops.")
    texts = [path.read_bytes() for path in (SOURCES / f"{name}.c", SOURCES / "vec.h")]
    key = hashlib.sha256(b"\0".join([*texts, cc.encode(), " ".join(FLAGS).encode()])).hexdigest()[:16]
    folder = Path(tempfile.gettempdir()) / f"vmri_jax-{getpass.getuser()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    library = folder / f"{name}-{key}.so"
    if not library.exists():
        with tempfile.TemporaryDirectory(dir=folder) as scratch:  # others may be compiling the same
            fresh = Path(scratch) / library.name
            command = [cc, *FLAGS, str(SOURCES / f"{name}.c"), "-o", str(fresh), "-lm"]
            done = subprocess.run(command, capture_output=True, text=True)
            if done.returncode:
                raise RuntimeError(f"c_loops: {' '.join(command)} failed:\n{done.stderr}")
            os.replace(fresh, library)
    return ctypes.CDLL(str(library))
