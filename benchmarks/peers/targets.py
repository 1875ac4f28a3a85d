"""What is aimed at: the least that a peer's time must be over ours."""

from benchmarks.peers.cases import LEVELS

RODS = ("TSP t=1", "TSP t=10", "SAM t=1", "SAM t=10")
TARGETS = (
    (("FPU l=3 t=1",), ("diffrax", "scipy", "OpenMM"), LEVELS, 3.0),
    (("FPU l=3 t=1",), ("heyoka",), (2e-4,), 1 / 3),
    (("FPU l=3 t=1",), ("heyoka",), (1e-8,), 1 / 5),
    (("FPU l=3 t=100",), ("diffrax", "scipy"), (1e-2, 2e-4), 5.0),
    (("FPU l=200 t=1",), ("heyoka",), (1e-2, 2e-4), 8.0),
    (("FPU l=200 t=1",), ("heyoka",), (2e-6,), 1.0),
    (RODS, ("OpenMM", "Exudyn", "MuJoCo", "diffrax", "scipy"), LEVELS, 1.0),
    (RODS, ("heyoka",), LEVELS, 1 / 5),
)
"""Some peers in some cases at some levels, and the least time over ours; below 1 it bounds how far we may be behind."""


def target(case: str, peer: str, level: float) -> float | None:
    """The least ratio aimed at, None where there is none."""
    return next(
        (least for cases, peers, levels, least in TARGETS if case in cases and peer in peers and level in levels), None
    )
