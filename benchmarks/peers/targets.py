"""What is aimed at: the least that a peer's time must be over ours."""

from dataclasses import dataclass

from benchmarks.peers.cases import BATCH_LEVEL, LEVELS


@dataclass(frozen=True)
class Target:
    """Of some peers in some cases at some levels; `at_least` below 1 bounds how far we may be behind."""

    cases: tuple[str, ...]
    peers: tuple[str, ...]
    levels: tuple[float, ...]
    at_least: float


RODS = ("TSP t=1", "TSP t=10", "SAM t=1", "SAM t=10")
TARGETS = (
    Target(("FPU l=3 t=1",), ("diffrax", "scipy", "OpenMM"), LEVELS, 3.0),
    Target(("FPU l=3 t=1",), ("heyoka",), (2e-4,), 1 / 3),
    Target(("FPU l=3 t=1",), ("heyoka",), (1e-8,), 1 / 5),
    Target(("FPU l=3 t=100",), ("diffrax", "scipy"), (1e-2, 2e-4), 5.0),
    Target(("FPU l=200 t=1",), ("heyoka",), (1e-2, 2e-4), 8.0),
    Target(("FPU l=200 t=1",), ("heyoka",), (2e-6,), 1.0),
    Target(RODS, ("OpenMM", "Exudyn", "MuJoCo", "diffrax", "scipy"), LEVELS, 1.0),
    Target(RODS, ("heyoka",), LEVELS, 1 / 5),
    Target(("FPU l=3 t=1, batch", "TSP t=1, batch"), ("heyoka", "diffrax"), (BATCH_LEVEL,), 1.0),
)


def target(case: str, peer: str, level: float) -> float | None:
    """The least ratio aimed at, None where there is none."""
    found = (t.at_least for t in TARGETS if case in t.cases and peer in t.peers and level in t.levels)
    return next(found, None)
