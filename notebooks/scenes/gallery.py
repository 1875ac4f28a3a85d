"""Run the scenes of this folder by the commands in their docstrings; write README.md with what they kept and a picture each.

python notebooks/scenes/gallery.py          # table and pictures
python notebooks/scenes/gallery.py films    # films_light.gif and films_dark.gif beside this folder
"""

import ast
import os
import resource
import shlex
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from PIL import Image, ImageSequence

import vmri_jax as vm
from vmri_jax.catalogue import imported
from vmri_jax.diagnostics import energy_parts, velocity
from vmri_jax.scene import Scene

HERE = Path(__file__).parent
ROOT = HERE.parent.parent
WIDTH = 1200
"""Of a picture, in points."""
FILMS = {"rigid_satellite": 8.0, "engine": 0.126, "simple_atomic_model": 20.0}
"""Scenes that are shown side by side in one film, and until when."""
SECONDS, HEIGHT, GAP, COLOURS = 4.0, 340, 24, 64
"""How long the film takes; height of its pictures and space between them, in points; how many colours it has."""
SYMMETRIC = 1e-9
"""Rates of Lagrangian and constraints below this are zero."""

HEAD = f"""# Scenes

Each file is a scene as a user writes one. `vmri simulate` runs it, `vmri animate` shows it, `vmri explain` says in which term and
on which grid each effect is, and its time. Without `--out`, `vmri animate` writes a page to play in a browser. Table and
pictures: `python notebooks/scenes/{Path(__file__).name}`.

Pictures: bodies at some times, with trails; below them a slow coordinate along the run, and a fast one during the time that is
shaded.

- *seconds*: processor time on one core, from the start of Python to the end, compilation included.
- *energy*: largest change of the energy, divided by the largest kinetic energy. Where forces act, their work at the saved nodes is
  subtracted from the change. Empty where constraints depend on time, because these do work.
- *constraints*: largest residual of positions.
- *momentum maps*: how many linear and angular momenta belong to symmetries of the scene, and their largest change, divided by
  the sum of the sizes of all terms.

| scene | slow, fast, constraints | scheme | H, micro steps, steps | seconds | energy | constraints | momentum maps |
|---|---|---|---|---|---|---|---|
"""


def scenes() -> list[Path]:
    """Files of this folder with a scene."""
    return [path for path in sorted(HERE.glob("*.py")) if path != Path(__file__)]


def docstring(path: Path) -> tuple[list[str], list[list[str]]]:
    """Paragraphs of a scene's docstring, and the words after ``vmri`` of its commands."""
    *paragraphs, commands = (ast.get_docstring(ast.parse(path.read_text())) or "").split("\n\n")
    return paragraphs, [shlex.split(line)[1:] for line in commands.splitlines()]


def option(words: list[str], name: str, default: str = "") -> str:
    """The value of an option on a command line."""
    return words[words.index(name) + 1] if name in words else default


def momentum_maps(system: vm.System, run: vm.Trajectory, size: int, shifted: tuple) -> list[np.ndarray]:
    """Linear and angular momenta (k,) of points in R^size along a run, of those motions that are symmetries, scaled.

    `shifted` says of every vector in q_s and of every one in q_f whether it is a point, or a director: a direction, which a
    translation leaves as it is. A translation or rotation ``xi = A x + b`` is one if Lagrangian and constraints do not change along it, at some states
    of the run. The scale is the largest sum of the sizes of all terms of ``p . xi``.
    """

    def functions(q, v):
        lagrangian = system.kinetic_energy(*q, *v)
        for potential, where in ((system.slow_potential, q), (system.fast_potential, q[1:])):
            lagrangian -= 0.0 if potential is None else potential(*where, system.params)
        return jnp.append(system.constraints(0.0, *q), lagrangian)

    def moved(matrix, shift, x):
        parts = zip(x, shifted, strict=True)
        return tuple(
            (part.reshape(-1, size) @ matrix.T + points[:, None] * shift).reshape(-1) for part, points in parts
        )

    @jax.jit
    def rate(matrix, shift, q, p):
        v = velocity(system, *q, *p)
        return jax.jvp(functions, (q, v), (moved(matrix, shift, q), moved(matrix, 0.0, v)))[1]

    zero, eye = np.zeros((size, size)), np.eye(size)
    motions = [(zero, b) for b in eye]
    motions += [(np.outer(eye[i], eye[j]) - np.outer(eye[j], eye[i]), zero[0]) for i in range(size) for j in range(i)]
    found = []
    for motion in motions:
        states = [((run.q_s[k], run.q_f[k]), (run.p_s[k], run.p_f[k])) for k in (0, len(run.t) // 2, -1)]
        if max(float(jnp.abs(rate(*motion, q, p)).max()) for q, p in states) < SYMMETRIC:
            q, p = (np.concatenate(pair, axis=1) for pair in ((run.q_s, run.q_f), (run.p_s, run.p_f)))
            shift = np.concatenate(shifted)[:, None] * motion[1]
            terms = p * (q.reshape(len(q), -1, size) @ motion[0].T + shift).reshape(q.shape)
            found.append(terms.sum(axis=1) / np.abs(terms).sum(axis=1).max())
    return found


def points_and_directors(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Of every vector in q_s and in q_f, 1 for a point and 0 for a director of a rigid body."""
    found: dict[str, list[float]] = {"s": [], "f": []}
    for name, place in scene.places.items():
        directors = place.size // 3 - 1 if scene.by_name[name].rigid else 0
        found[place.part] += [1.0] + [0.0] * directors
    return np.array(found["s"]), np.array(found["f"])


class Kept(NamedTuple):
    """Largest errors along a run: of the energy, of the constraints' positions, of so many momentum maps."""

    energy: float
    constraints: float
    maps: int
    momentum: float


def kept(scene: Scene, run: vm.Trajectory) -> Kept:
    """What a run of a scene kept, see the head of the table."""
    system = scene.system()

    @jax.jit
    @jax.vmap
    def kinetic_and_power(t, q_s, q_f, p_s, p_f):
        v_s, v_f = velocity(system, q_s, q_f, p_s, p_f)
        force_s, force_f = system.forces(t, q_s, q_f, v_s, v_f)
        return energy_parts(system, q_s, q_f, p_s, p_f)["kinetic"], force_s @ v_s + force_f @ v_f

    kinetic, power = kinetic_and_power(run.t, run.q_s, run.q_f, run.p_s, run.p_f)
    work = np.append(0.0, np.cumsum(np.diff(run.t) * (power[1:] + power[:-1]) / 2))
    balance = np.asarray(run.energy) - run.energy[0] - work
    sizes = {0 if body.block else body.point().size for body in scene.bodies}
    counted = len(sizes) == 1 and 0 not in sizes and system.force is None
    maps = momentum_maps(system, run, *sizes, shifted=points_and_directors(scene)) if counted else []
    momentum = max((float(np.abs(values - values[0]).max()) for values in maps), default=0.0)
    energy = np.nan if system.is_rheonomic else float(np.abs(balance).max() / kinetic.max())
    return Kept(energy, float(run.constraint_residual[:, 0].max()), len(maps), momentum)


def vmri(*words: str, cache: Path) -> None:
    """Run a command; programs that others compiled are not used."""
    environment = os.environ | {"XDG_CACHE_HOME": str(cache)}
    subprocess.run([sys.executable, "-m", "vmri_jax.cli", *words], cwd=ROOT, check=True, env=environment)


def row(path: Path, folder: Path) -> str:
    """The row of a scene, which runs it and draws its picture."""
    simulate, animate = docstring(path)[1]
    out = str(folder / option(simulate, "--out"))
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    vmri(*simulate[:-1], out, cache=folder)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    vmri("animate", out, *animate[2:], "--out", str(path.with_suffix(".png")), cache=folder)
    shrink(path.with_suffix(".png"))
    scene, run = imported(f"{path}:scene"), vm.Trajectory.load(out)
    found = kept(scene, run)
    sizes = [run.q_s.shape[1], run.q_f.shape[1], sum(scene.system().num_constraints(run.q_s[0], run.q_f[0]))]
    cells = [
        f"[{path.stem}](#{path.stem})",
        ", ".join(map(str, sizes)),
        option(simulate, "--scheme", "fully-implicit"),
        ", ".join(option(simulate, name) for name in ("--macro-dt", "--num-micro", "--steps")),
        f"{after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime:.0f}",
        f"{found.energy:.0e}" if np.isfinite(found.energy) else "",
        f"{found.constraints:.0e}" if sizes[2] else "",
        f"{found.maps}: {found.momentum:.0e}" if found.maps else "",
    ]
    return "| " + " | ".join(cells) + " |"


def section(path: Path) -> str:
    """What a scene is about, how to run it, its picture."""
    paragraphs, commands = docstring(path)
    lines = "\n".join(shlex.join(["vmri", *words]) for words in commands)
    about = "\n".join(paragraphs)
    return f"## {path.stem}\n\n{about}\n\n```sh\n{lines}\n```\n\n![{path.stem}]({path.stem}.png)\n"


def shrink(path: Path) -> None:
    """A picture of few colours as a small file."""
    picture = Image.open(path).convert("RGB")
    picture.thumbnail((WIDTH, WIDTH))
    picture.quantize(128).save(path, optimize=True)


def write_films() -> None:
    """Some scenes side by side, in light and in dark colours."""
    with tempfile.TemporaryDirectory() as folder:
        for name, until in FILMS.items():
            simulate, animate = docstring(HERE / f"{name}.py")[1]
            run = f"{folder}/{option(simulate, '--out')}"
            vmri(*simulate[:-1], run, cache=Path(folder))
            view = [word for word in animate if word.startswith("--view")]
            for colours in ("light", "dark"):
                out = ["--out", f"{folder}/{name}_{colours}.gif", "--to", str(until), "--seconds", str(SECONDS)]
                vmri("animate", run, *out, *view, *["--dark"] * (colours == "dark"), cache=Path(folder))
        for colours in ("light", "dark"):
            films = [f"{folder}/{name}_{colours}.gif" for name in FILMS]
            write_side_by_side(films, HERE.parent / f"films_{colours}.gif")


def write_side_by_side(films: list[str], path: Path) -> None:
    """One film of several that are equally long."""
    rows = []
    for frames in zip(*(ImageSequence.all_frames(Image.open(film)) for film in films), strict=True):
        pictures = [frame.convert("RGB") for frame in frames]
        pictures = [picture.resize((picture.width * HEIGHT // picture.height, HEIGHT)) for picture in pictures]
        width = sum(picture.width + GAP for picture in pictures) - GAP
        row = Image.new("RGB", (width, HEIGHT), pictures[0].getpixel((0, 0)))
        left = 0
        for picture in pictures:
            row.paste(picture, (left, 0))
            left += picture.width + GAP
        rows.append(row)
    palette = rows[len(rows) // 2].quantize(COLOURS)
    first, *others = (row.quantize(palette=palette, dither=Image.Dither.NONE) for row in rows)
    first.save(path, save_all=True, append_images=others, duration=1000 * SECONDS / len(rows), loop=0, optimize=True)


def main(films: bool) -> None:
    if films:
        write_films()
        return
    jax.config.update("jax_enable_x64", True)
    with tempfile.TemporaryDirectory() as folder:
        rows = [row(path, Path(folder)) for path in scenes()]
    sections = [section(path) for path in scenes()]
    (HERE / "README.md").write_text(HEAD + "\n".join(rows) + "\n\n" + "\n".join(sections), encoding="utf-8")


if __name__ == "__main__":
    main("films" in sys.argv[1:])
