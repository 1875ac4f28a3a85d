"""A scene against the system written by hand: time per micro step and instructions of the reference systems, in turns."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from benchmarks import programs
from benchmarks.measure import Tell, interleaved, quartiles, ratio, silent
from benchmarks.report import Claim, Report
from vmri_jax.catalogue import imported
from vmri_jax.scene import Scene
from vmri_jax.scene.ledger import operations, prepare_steps, temporary_bytes

COLUMNS = ("system", "scheme", "program", "µs/micro step", "quartiles", "operations", "bytes")
GALLERY = Path(__file__).parents[1] / "notebooks" / "scenes"
SCENES = {"FPU l=3": "fermi_pasta_ulam", "TSP": "triple_spherical_pendulum", "SAM": "simple_atomic_model"}
"""Files of the gallery by the names of the systems."""
MOST = 1.03
"""A scene over the system written by hand: time per micro step."""


@dataclass(frozen=True)
class Size:
    """How much is run: systems, schemes, their steps, and samples of a time."""

    systems: tuple[str, ...]
    schemes: tuple[str, ...]
    repeats: int
    num_micro: int = 10
    micro_dt: float = 2e-4
    num_steps: int = 2000


def gallery_scene(name: str) -> Scene:
    """The scene in a file of the gallery."""
    return imported(f"{GALLERY / name}.py:scene")


def sizes(name: str) -> Size:
    """ "quick" or "full"."""
    if name == "quick":
        return Size(tuple(SCENES), ("fully explicit",), 15)
    return Size(tuple(SCENES), tuple(programs.SCHEMES), 25)


def run(size: Size, name: str, tell: Tell = silent) -> Iterator[Report]:
    """A report after each system and scheme; seconds of processor time."""
    rows, claims = [], []
    for system in size.systems:
        scene = gallery_scene(SCENES[system])
        for scheme in size.schemes:
            tell(f"{system}, {scheme}")
            problems = {"scene": scene.problem(), "by hand": programs.problem(system)}
            made, macro_dt = programs.SCHEMES[scheme](size.num_micro), size.num_micro * size.micro_dt
            prepared = {
                key: prepare_steps(problem.system, made, problem.state(), macro_dt, num_steps=size.num_steps)
                for key, problem in problems.items()
            }
            timed = {key: run.timed() for key, run in prepared.items()}
            seconds = interleaved(timed, size.repeats)
            for key, run in prepared.items():
                program, us = run.compiled(), quartiles(seconds[key], 1e6 / size.num_steps / size.num_micro)
                row = {"system": system, "scheme": scheme, "program": key, "µs/micro step": us.value}
                row |= {"quartiles": f"{us.low:.3g} to {us.high:.3g}", "operations": sum(operations(program).values())}
                rows.append(row | {"bytes": temporary_bytes(program)})
            label = f"{system}, {scheme}: scene over by hand"
            claims.append(Claim(label, ratio(seconds["scene"], seconds["by hand"]), MOST))
            yield Report("scenes", name, rows, claims, [])
