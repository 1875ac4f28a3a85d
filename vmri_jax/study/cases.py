"""Cases of a convergence study: the sets of parameters, each with its problem and its reference solution."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import jax
import numpy as np

from vmri_jax import diagnostics
from vmri_jax.mechanics.state import Problem
from vmri_jax.running.progress import Progress
from vmri_jax.study.reference_solution import ReferenceSolution, reference_solution


@dataclass(frozen=True)
class Case:
    """One set of parameters: its label, the problem with it, and the reference solution."""

    label: str
    problem: Problem
    reference: ReferenceSolution

    @cached_property
    def energies(self) -> np.ndarray | None:
        """(num_saves + 1,) energies of the reference; None where the system keeps its energy: the energy at the start then serves."""
        if self.problem.system.keeps_energy:
            return None
        n_s = self.problem.q_s.size
        phase = [part for array in (self.reference.q, self.reference.p) for part in np.split(array, [n_s], axis=1)]
        return np.asarray(jax.jit(jax.vmap(partial(diagnostics.energy, self.problem.system)))(*phase))


def cases_of(
    problem: Problem,
    params: Mapping[str, Any] | None,
    reference: ReferenceSolution | Mapping[str, ReferenceSolution] | None,
    t_end: float,
    num_saves: int,
    progress: Progress,
) -> list[Case]:
    """The cases of `convergence_study`; refuses references with other labels or of another shape."""
    if params is not None and not params:
        raise ValueError("convergence_study: params is empty; give a set of parameters by label, or leave it out.")
    problems = (
        {"": problem}
        if params is None
        else {label: replace(problem, system=problem.system.replace(params=p)) for label, p in params.items()}
    )
    references = _references(problems, reference, t_end, num_saves, progress)
    return [Case(label, changed, references[label]) for label, changed in problems.items()]


def _references(
    problems: Mapping[str, Problem], reference, t_end: float, num_saves: int, progress: Progress
) -> dict[str, ReferenceSolution]:
    """A reference solution for every problem, by label; references of the user are checked for their shape."""
    if reference is None:
        return {
            label: reference_solution(problem, t_end, num_saves=num_saves, progress=progress)
            for label, problem in problems.items()
        }
    by_label = isinstance(reference, Mapping)
    references: dict[str, Any] = dict(reference if by_label else dict.fromkeys(problems, reference))
    if set(references) != set(problems) or (len(problems) > 1 and not by_label):
        raise ValueError(
            f"convergence_study: params has the labels {list(problems)}, so reference must be a mapping with the same labels."
        )
    for label, problem in problems.items():
        shape = (num_saves + 1, problem.q_s.size + problem.q_f.size)
        q, p = references[label].q, references[label].p
        if q.shape != shape or p.shape != shape:
            raise ValueError(
                f"convergence_study: reference has q of shape {q.shape} and p of shape {p.shape}; both "
                f"must be {shape}: num_saves + 1 nodes from the start to t_end, slow coordinates first."
            )
    return references
