"""Figures 4 and 5 of the reference study: where its dense solve was cheapest."""

from collections.abc import Mapping
from dataclasses import replace

from benchmarks.curves import Case
from benchmarks.gail2014.reference import paper_minimum

TITLES = {
    "cost_fig4": "Fig. 4 of the reference study redone",
    "cost_fig5": "Fig. 5 of the reference study redone",
}
FPU_DT, SAM_DT = 0.01, 0.001
"""Micro steps of the paper."""
T_END = 24.0
"""Simulated time of a fully implicit chain: with macro steps of length 1 Newton's iteration soon fails."""
AMPLITUDE = 1e-3
"""Start of an explicit chain, over that of the paper: with this one macro steps of length 1 are stable."""


def cases(
    small: tuple[int, ...], chain: tuple[int, ...], chain_lengths: Mapping[str, tuple[int, ...]]
) -> dict[str, tuple[Case, ...]]:
    """The cases of both figures: num_micro in Fig. 4 and in Fig. 5, and numbers of springs in Fig. 5 by scheme."""
    four = (
        at_paper_steps(Case("FPU l=3", "fully implicit", FPU_DT, small, small, 1.8, 5.0, 60)),
        Case("SAM", "fully implicit", SAM_DT, small, small, 1.8, 10.0, 20),
    )
    five = tuple(
        at_paper_steps(Case(f"FPU l={length}", scheme, FPU_DT, chain, chain, None, 10.0, paper_minimum(scheme, length)))
        for scheme, lengths in chain_lengths.items()
        for length in lengths
    )
    return dict(zip(TITLES, (four, five), strict=True))


def at_paper_steps(case: Case) -> Case:
    """The same chain set up for the large macro steps of the paper."""
    if case.scheme == "fully implicit":
        return replace(case, t_end=T_END)
    return replace(case, amplitude=AMPLITUDE)
