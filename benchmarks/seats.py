"""Worker processes that take turns, sample by sample: checkouts, or forms of the kernels."""

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np

from benchmarks.worker import Case

HERE = Path(__file__).resolve().parent


class Refused(RuntimeError):
    """A worker could not do what it was asked; the message is its own."""


@dataclass(frozen=True)
class Seat:
    """Where a worker sits: the checkout whose `vmri_jax` it imports, and how it is started."""

    checkout: Path = HERE.parent
    python: Path = Path(sys.executable)
    options: tuple[str, ...] = ()
    environment: Mapping[str, str] = field(default_factory=dict)

    @property
    def commit(self) -> str:
        """Of the checkout, with a plus sign if files differ from it."""
        command = ["git", "-C", str(self.checkout), "describe", "--always", "--abbrev=10", "--exclude=*", "--dirty=+"]
        return subprocess.run(command, capture_output=True, text=True).stdout.strip()


class Worker:
    """A process in a `Seat`, without a cache of programs; it ends with its context."""

    def __init__(self, seat: Seat):
        environment = os.environ | {"JAX_ENABLE_COMPILATION_CACHE": "false", **seat.environment}
        environment.pop("XLA_FLAGS", None)  # each side makes its own
        command = [str(seat.python), str(HERE / "worker.py"), *seat.options]
        self.errors = tempfile.TemporaryFile("w+")  # noqa: SIM115, open as long as the process
        self.started = time.perf_counter()
        self.process = subprocess.Popen(
            command,
            cwd=seat.checkout,
            env=environment,
            text=True,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self.errors,
        )

    def __enter__(self) -> "Worker":
        return self

    def __exit__(self, *_) -> None:
        self.process.kill()
        self.process.communicate()
        self.errors.close()

    def make(self, case: Case) -> dict:
        """Compile and run a case once; number of steps, the end and the status of the run."""
        return self._ask({"do": "make", "case": asdict(case)})

    def sample(self) -> float:
        """Seconds of the case that was made last."""
        return self._ask({"do": "sample"})["seconds"]

    def _ask(self, question: dict) -> dict:
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.write(json.dumps(question) + "\n")
        self.process.stdin.flush()
        line = self.process.stdout.readline()
        if not line:
            self.errors.seek(0)
            raise RuntimeError(f"benchmarks: the worker of {self.process.args} ended:\n{self.errors.read()[-2000:]}")
        answer = json.loads(line)
        if "error" in answer:
            raise Refused(answer["error"])
        return answer


@dataclass(frozen=True)
class Outcome:
    """What one case gave by seat: samples in seconds, answers of `Worker.make`, or why there are none."""

    samples: dict[str, list[float]]
    made: dict[str, dict]
    refused: dict[str, str]

    def difference(self, a: str, b: str) -> float | None:
        """Largest difference of the ends of two seats, relative to the largest number of b."""
        if a not in self.made or b not in self.made:
            return None
        x, y = (np.array(self.made[name]["end"]) for name in (a, b))
        return float(np.max(np.abs(x - y)) / np.max(np.abs(y)))


def take_turns(workers: Mapping[str, Worker], case: Case, repeats: int) -> Outcome:
    """Run a case on every worker, as many steps on all of them, and time it in turns."""
    made, refused = {}, {}
    for name, worker in workers.items():
        try:
            made[name] = worker.make(case)
            case = replace(case, num_steps=made[name]["num_steps"])
        except Refused as error:
            refused[name] = str(error)
    samples: dict[str, list[float]] = {name: [] for name in made}
    for i in range(repeats):
        for name in _rotated(list(made), i):
            samples[name].append(workers[name].sample())
    return Outcome(samples, made, refused)


def first_results(seats: Mapping[str, Seat], case: Case, repeats: int) -> Outcome:
    """Seconds from the start of a process to its first result, each time in a fresh one."""
    samples: dict[str, list[float]] = {name: [] for name in seats}
    made, refused = {}, {}
    for i in range(repeats):
        for name in _rotated([name for name in seats if name not in refused], i):
            with Worker(seats[name]) as worker:
                try:
                    made[name] = worker.make(case)
                    wall = time.perf_counter() - worker.started
                    samples[name].append(min(made[name]["processor"], wall))
                except Refused as error:
                    refused[name] = str(error)
    return Outcome({name: samples[name] for name in made}, made, refused)


def _rotated(names: Sequence[str], i: int) -> list[str]:
    """Every round starts with another one."""
    start = i % max(1, len(names))
    return [*names[start:], *names[:start]]
