"""Whether the tests catch mistakes: each mutation of `tests/data/mutations.txt` is put into a copy
of the tree, whose tests should fail.

    python -m tests.mutations                      # all, most within a minute
    python -m tests.mutations 3 7 --processes 2    # some of them
    python -m tests.mutations --wider              # where the named files pass, also all files of their folders

In the table `# steppers/rattle.py: steppers/test_drift.py` names a file of the package and the files of tests that are
run; each line below is a mutation of that file, `fragment -> replacement`. The first test that fails catches it.
"""

import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import SimpleQueue
from shutil import copytree, ignore_patterns
from tempfile import TemporaryDirectory
from typing import Annotated, NamedTuple

import typer

ROOT = Path(__file__).parents[1]
PYTEST = ["-m", "pytest", "-x", "-q", "--unoptimised", "-p", "no:xdist", "-o", f"cache_dir={ROOT / '.pytest_cache'}"]
OMITTED = ignore_patterns(".*", "__pycache__", "build", "dist")
LONGEST = 600
"""Seconds after which tests are ended, since a mutation may make a loop endless; fewer would end slow tests."""


class Mutation(NamedTuple):
    """A fragment of a file of the package with its replacement, and the test files that should catch it."""

    number: int
    file: str
    fragment: str
    replacement: str
    tests: tuple[str, ...]

    def __str__(self) -> str:
        return f"{self.number:3d}  {self.file}: {self.fragment}  ->  {self.replacement}"

    def into(self, tree: Path) -> tuple[Path, str, str]:
        """The file in a tree, its text, and its text with the replacement."""
        path = tree / "vmri_jax" / self.file
        text = path.read_text()
        if (count := text.count(self.fragment)) != 1:
            raise ValueError(f"mutations.txt: {self}\nThe file has the fragment {count} times; it must have it once.")
        return path, text, text.replace(self.fragment, self.replacement)


def table(text: str) -> list[Mutation]:
    """The mutations of a table, numbered from 1."""
    mutations, file, tests = [], "", ()
    for line in filter(None, map(str.strip, text.splitlines())):
        if line.startswith("# "):
            file, names = line.removeprefix("# ").split(": ")
            tests = tuple(names.split())
        else:
            fragment, replacement = line.split(" -> ")
            mutations.append(Mutation(len(mutations) + 1, file, fragment, replacement, tests))
    return mutations


def failure(tree: Path, files: tuple[str, ...]) -> str:
    """The first test of these files that fails; empty if all pass."""
    environment = os.environ | {"PYTHONPATH": str(tree), "PYTHONDONTWRITEBYTECODE": ""}
    command = [sys.executable, *PYTEST, *(f"tests/{name}" for name in files)]
    try:
        run = subprocess.run(command, cwd=tree, env=environment, capture_output=True, text=True, timeout=LONGEST)
    except subprocess.TimeoutExpired:
        return f"no end within {LONGEST} s"
    failed = [line for line in run.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))]
    if run.returncode and not failed:  # pytest itself failed
        raise RuntimeError(f"{' '.join(command)}\n{run.stdout[-2000:]}{run.stderr[-2000:]}")
    return failed[0] if failed else ""


def caught(mutation: Mutation, trees: SimpleQueue, wider: bool) -> bool:
    """Run the tests with a mutation in one of the free trees, and print a line."""
    tree, start = trees.get(), time.monotonic()
    path, original, mutated = mutation.into(tree)
    path.write_text(mutated)
    try:
        failed = failure(tree, mutation.tests)
        if wider and not failed:
            failed = failure(tree, tuple({str(Path(name).parent) for name in mutation.tests}))
    finally:
        path.write_text(original)
        trees.put(tree)
    outcome = f"caught by {failed}" if failed else "SURVIVED"
    print(f"{mutation}\n     {time.monotonic() - start:.0f} s, {outcome[:160]}", flush=True)
    return bool(failed)


def main(
    numbers: Annotated[list[int] | None, typer.Argument(help="Mutations by number; by default all.")] = None,
    processes: Annotated[int, typer.Option(help="Mutations at a time.")] = 1,
    wider: Annotated[bool, typer.Option("--wider", help="Where these files pass, also their folders.")] = False,
) -> None:
    """Run the tests with each mutation; exit status 1 if one survives."""
    mutations = table((ROOT / "tests/data/mutations.txt").read_text())
    for mutation in mutations:
        compile(mutation.into(ROOT)[2], mutation.file, "exec")
        for name in mutation.tests:
            assert (ROOT / "tests" / name).exists(), f"tests/data/mutations.txt: {mutation}\nThere is no tests/{name}."
    chosen = [mutation for mutation in mutations if not numbers or mutation.number in numbers]
    with TemporaryDirectory() as folder, ThreadPoolExecutor(processes) as pool:
        trees = SimpleQueue()
        for i in range(processes):
            trees.put(copytree(ROOT, Path(folder, str(i)), ignore=OMITTED))
        results = list(pool.map(lambda mutation: caught(mutation, trees, wider), chosen))
    print(f"{sum(results)} of {len(results)} mutations caught")
    raise typer.Exit(not all(results))


if __name__ == "__main__":
    typer.run(main)
