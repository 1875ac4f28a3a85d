"""The reference study as data: which figures there are, what they run, and what the paper saw.

Gail, Leyendecker, Ober-Bloebaum (2014), "On the role of quadrature rules and system dimensions in variational multirate
integrators"; orders of higher degree from Ober-Bloebaum, Wenger, Gail, Leyendecker (2024), arXiv:2406.12991. The
explicit schemes of the paper have order 1: they have alpha = 0 here.
"""

from dataclasses import dataclass, replace
from functools import partial

import vmri_jax as vm
from benchmarks.gail2014.figures import ConvergenceFigure, CostFigure, CostPanel
from vmri_jax import systems

PAPER_STEPS = (0.1, 0.05, 0.02, 0.01, 0.005, 0.002, 0.001, 0.0005, 0.0002, 0.0001)
DEGREE_STEPS = (0.05, 0.025, 0.02, 0.0125, 0.01, 0.005, 0.002, 0.001)
"""Order 6 falls from the first errors to round-off within a decade of steps: more of them there."""
PAPER_NUM_MICRO = (1, 4, *range(8, 101, 4))
PAPER_MINIMA = {  # cheapest num_micro by scheme: (smallest l, largest l, num_micro)
    "fully implicit": ((70, 80, 12), (90, 100, 8), (110, 200, 1)),
    "explicit slow": ((70, 110, 12), (120, 180, 8), (190, 200, 1)),
    "fully explicit": ((70, 130, 8), (140, 200, 4)),
}


def paper_minimum(scheme: str, num_springs: int) -> int | None:
    """The cheapest num_micro in Fig. 5, None where the paper does not say."""
    found = [n for low, high, n in PAPER_MINIMA[scheme] if low <= num_springs <= high]
    return found[0] if found else None


SCHEMES = {
    "fully implicit": vm.fully_implicit,
    "explicit slow": partial(vm.explicit_slow, alpha=0.0),
    "fully explicit": partial(vm.fully_explicit, alpha=0.0),
}


@dataclass(frozen=True)
class Size:
    """How much is run.

    fpu_steps, tsp_steps: macro steps of the convergence figures.
    fpu, sam, chain: micro steps per macro step, of the dense and of the structured solve, in Fig. 4 and 5; the
        structured cost is compared from about `SETTLED` on.
    chain_lengths: l in Fig. 5.
    others: solvers beside the dense and the structured one in Fig. 4.
    largest_dense: most unknowns for which the dense solve is run.
    repeats: samples of each time, of whose medians claims are made.
    degree_num_micro: micro steps per macro step in the figures of degree 2 and 3.
    """

    fpu_steps: tuple[float, ...]
    tsp_steps: tuple[float, ...]
    fpu: tuple[tuple[int, ...], tuple[int, ...]]
    sam: tuple[tuple[int, ...], tuple[int, ...]]
    chain: tuple[tuple[int, ...], tuple[int, ...]]
    chain_lengths: tuple[int, ...]
    others: tuple[str, ...]
    largest_dense: int
    repeats: int
    degree_num_micro: tuple[int, ...]


ATOMS_NUM_MICRO = (1, 4, 8, 12, 16, 20, 24, 32, 40, 60, 80, 100)
CHAIN_NUM_MICRO = (1, 4, 8, 12, 16, 20, 40, 60, 100)
SIZES = {
    "quick": Size(
        fpu_steps=PAPER_STEPS[:-1],
        tsp_steps=PAPER_STEPS[1:-2],
        fpu=((1, 60, 100), (10, 100)),
        sam=((1, 20, 40), (10, 40)),
        chain=((1, 20), (8, 20)),
        chain_lengths=(30,),
        others=(),
        largest_dense=1000,
        repeats=7,
        degree_num_micro=(5,),
    ),
    "full": Size(
        fpu_steps=PAPER_STEPS,
        tsp_steps=PAPER_STEPS[1:],
        fpu=(PAPER_NUM_MICRO, PAPER_NUM_MICRO),
        sam=(ATOMS_NUM_MICRO, ATOMS_NUM_MICRO),
        chain=(CHAIN_NUM_MICRO, CHAIN_NUM_MICRO),
        chain_lengths=(10, 40, 70, 100, 150, 200),
        others=("null_space",),
        largest_dense=2500,
        repeats=7,
        degree_num_micro=(5, 10),
    ),
}


def reference_figures(size: str = "quick") -> tuple[ConvergenceFigure | CostFigure, ...]:
    """The figures in the order of the report, "quick" with few values or "full" with the lists of the paper."""
    if size not in SIZES:
        raise ValueError(f"reference_figures: size is {size!r}; it must be one of {', '.join(SIZES)}.")
    chosen = SIZES[size]
    return (*_cost_figures(chosen), *_fpu_figures(chosen), *_tsp_figures(chosen))


def _cost_figures(size: Size) -> tuple[CostFigure, ...]:
    chain, atoms, scheme = systems.fermi_pasta_ulam, systems.simple_atomic_model, vm.fully_implicit
    small = (
        CostPanel("FPU, l = 3", chain, chain, scheme, 60, *size.fpu, 0.01, 2.0, 20.0, size.repeats),
        CostPanel("SAM", atoms, atoms, scheme, 20, *size.sam, 0.001, 0.08, 1.0, size.repeats, size.others),
    )
    chains = tuple(_chain_panel(size, name, length) for name in SCHEMES for length in size.chain_lengths)
    return (
        CostFigure(
            "fig4",
            "Computing time against micro steps",
            "FPU with l = 3 is cheapest at 60 micro steps per macro step (183 unknowns), the simple atomic model at 20 "
            "(307 unknowns); then the dense solve makes the curves turn up again.",
            small,
        ),
        CostFigure(
            "fig5",
            "Computing time of longer chains",
            "The cheapest number of micro steps falls with the number of springs: fully implicit from 12 at l = 70 to "
            "1, no gain, from l = 110; explicit slow from 12 to 8 (l = 120); fully explicit from 8 to 4 (l = 140).",
            chains,
        ),
    )


def _chain_panel(size: Size, scheme: str, num_springs: int) -> CostPanel:
    chain = partial(systems.fermi_pasta_ulam, num_springs)
    dense, structured = size.chain
    feasible = tuple(n for n in dense if num_springs * (n + 1) <= size.largest_dense)
    return CostPanel(
        title=f"{scheme}, l = {num_springs}",
        dense=chain if scheme == "fully implicit" else lambda: unstructured(chain()),
        structured=chain,
        scheme=SCHEMES[scheme],
        paper_minimum=paper_minimum(scheme, num_springs),
        dense_num_micro=feasible,
        num_micro=structured,
        micro_dt=0.01,
        dense_t_end=0.2,
        t_end=10.0 if scheme == "fully explicit" else min(10.0, max(0.5, 4000 / num_springs**2)),  # solves cost l^3
        repeats=size.repeats,
    )


def kinetic_energy(q_s, q_f, v_s, v_f, params):
    """Unit masses as a function, so that nothing is known of the structure of T."""
    return (v_s @ v_s + v_f @ v_f) / 2


def unstructured(problem: vm.Problem) -> vm.Problem:
    """A chain with T as a plain function: every scheme then solves for all unknowns of a macro step at once."""
    return replace(problem, system=problem.system.replace(kinetic=kinetic_energy))


def _both(scheme, **arguments) -> dict[str, vm.Scheme]:
    return {f"{n} micro steps": scheme(n, **arguments) for n in (5, 10)}


def _convergence_figure(
    problem, macro_dt, name: str, title: str, paper: str, schemes: dict[str, vm.Scheme], source="paper"
) -> ConvergenceFigure:
    orders = {label: scheme.order for label, scheme in schemes.items()}
    return ConvergenceFigure(name, title, paper, problem, schemes, orders, source, macro_dt)


def _fpu_figures(size: Size) -> tuple[ConvergenceFigure, ...]:
    figure = partial(_convergence_figure, systems.fermi_pasta_ulam, size.fpu_steps)
    finer = partial(_convergence_figure, systems.fermi_pasta_ulam, DEGREE_STEPS)
    saw = "order {} in positions and momenta, with 5 and with 10 micro steps."
    half = {
        f"{name}, {label}": scheme
        for name, family in (("explicit slow", vm.explicit_slow), ("fully explicit", vm.fully_explicit))
        for label, scheme in _both(family, alpha=0.5).items()
    }
    return (
        figure("fig6", "FPU, fully explicit", saw.format(1), _both(vm.fully_explicit, alpha=0.0)),
        figure("fig7", "FPU, explicit slow", saw.format(1), _both(vm.explicit_slow, alpha=0.0)),
        figure("fig8", "FPU, fully implicit", saw.format(2), _both(vm.fully_implicit)),
        figure("fpu-half", "FPU, explicit schemes with α = 1/2", _NOT_IN_PAPER, half, "theory"),
        finer("fpu-degree", "FPU, degree 2 and 3", _NOT_IN_PAPER, _degrees(size.degree_num_micro), "theory"),
    )


def _tsp_figures(size: Size) -> tuple[ConvergenceFigure, ...]:
    figure = partial(_convergence_figure, systems.triple_spherical_pendulum, size.tsp_steps)
    finer = partial(_convergence_figure, systems.triple_spherical_pendulum, DEGREE_STEPS)
    tsp = "Triple spherical pendulum"
    half = _both(vm.fully_explicit, alpha=0.5)
    return (
        figure("fig9", f"{tsp}, fully implicit", "order 2.", _both(vm.fully_implicit)),
        figure("fig10", f"{tsp}, fully explicit", "order 1.", _both(vm.fully_explicit, alpha=0.0)),
        figure("tsp-half", f"{tsp}, fully explicit with α = 1/2", _NOT_IN_PAPER, half, "theory"),
        finer("tsp-degree", f"{tsp}, degree 2 and 3", _NOT_IN_PAPER, _degrees(size.degree_num_micro), "theory"),
    )


_NOT_IN_PAPER = "not in the paper; the theory says order min(2 × degree, order of the quadrature)."


def _degrees(num_micro: tuple[int, ...]) -> dict[str, vm.Scheme]:
    """Galerkin schemes of degree 2 and 3 with Gauss quadrature, of order 4 and 6."""
    return {
        f"degree {degree}, {n} micro steps": vm.galerkin(n, degree, "gauss") for degree in (2, 3) for n in num_micro
    }
