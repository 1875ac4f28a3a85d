"""The programs in the README and in the pages of `docs` run as printed, their numbers hold, and their links lead
somewhere."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

import vmri_jax as vm

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
TEXT = "\n".join(path.read_text() for path in PAGES)
PROGRAMS = re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)


def programs(page: str) -> list[str]:
    """The programs of a page."""
    return re.findall(r"```python\n(.*?)```", (ROOT / page).read_text(), re.DOTALL)


def printed(program: str, folder: Path) -> str:
    """What a program prints, which runs in a folder and in a process of its own, since settings are read when JAX
    starts."""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False, cwd=folder)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_example_runs(tmp_path):
    """The steps that it chooses depend on measured times."""
    checks = 'assert run.q_f["atoms"].shape == (len(run), 32, 2, 3)\nassert run.error.largest <= 1e-5\n'
    said = printed("".join([*programs("README.md"), checks]), tmp_path)
    numbers = re.compile(r"\d[\d.e-]*")
    shown = re.search(r"It prints.*?```text\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    assert shown is not None
    ours, theirs = ([numbers.sub("", line) for line in text.splitlines()[1:]] for text in (said, shown.group(1)))
    assert ours == theirs
    assert int(re.findall(r"explicit\((\d+)", said)[0]) > 1
    assert float(numbers.findall(said)[-1]) > 2  # the gain; measured 3.5 to 4.6, on a busy core, too
    assert (tmp_path / "run.png").stat().st_size > 10_000
    assert (tmp_path / "run.csv").read_text().startswith('t,"atoms[0,0] x","atoms[0,0] y",')


def test_the_program_of_the_nutshell_runs(tmp_path):
    """A crane whose bodies have names: it prints what the page says."""
    checks = 'assert run.q_f["load"].shape == (201, 2)\nassert len(run[100:]) == 101\n'
    said = printed("".join([*programs("docs/nutshell.md")[:2], checks]), tmp_path)
    assert [f"`{line}`" in TEXT for line in said.splitlines()] == [True, True], said
    assert (tmp_path / "run.png").stat().st_size > 10_000
    assert (tmp_path / "run.csv").read_text().startswith("t,trolley,hook x,hook y,load x,load y,v trolley,")


def test_scenes_run():
    """Points and springs, then rigid bodies and a hinge, one after the other as they stand there."""
    scope = {}
    for start in ("scene = ", "hub = "):
        exec(next(program for program in programs("docs/how_to/scenes.md") if f"\n\n{start}" in program), scope)
    for name, places in (("scene", {"hook": "s", "bell": "f"}), ("satellite", {"hub": "s", "panel": "f"})):
        scene = scope[name]
        assert {body: scene.places[body].part for body in places} == places
        assert vm.simulate(scene, vm.fully_implicit(num_micro=10), macro_dt=0.01, num_steps=10).success


@pytest.mark.parametrize(("call", "picture"), [("vm.ensemble(", "runs.png"), ("vm.fit(", "fit.png")])
def test_programs_with_figures(call, picture, tmp_path):
    said = printed(next(program for program in PROGRAMS if call in program), tmp_path)
    assert f"`{said.strip()}`" in TEXT or said.splitlines()[0] in TEXT, said
    assert (tmp_path / picture).stat().st_size > 10_000


# a phrase from each program of a page, with the output that the page prints below it; the programs share a namespace
SHOWN = {
    "how_to/systems.md": ("", 'q_f["radius"]'),
    "how_to/steppers.md": ("class Rotation",),
    "coming_from/index.md": ("25.0 * q_s[",),
    "how_to/measurements.md": ("",),
    "how_to/scenes.md": ("crank pin", "a spring between"),
    "how_to/accuracy.md": ("hinge",),
}


@pytest.mark.parametrize("page", SHOWN)
def test_programs_print_what_their_page_shows(page, capsys, tmp_path, monkeypatch):
    text, scope = (ROOT / "docs" / page).read_text(), {"__name__": "program", "vm": vm}
    monkeypatch.chdir(tmp_path)
    for words in SHOWN[page]:
        exec(next(program for program in programs(f"docs/{page}") if words in program), scope)
        said = capsys.readouterr().out
        assert f"```text\n{said}```" in text or f"`{said.strip()}`" in text, said
    if page == "how_to/systems.md":
        assert scope["run"].reaction_forces("rail")["trolley"].shape == (801, 2)


def test_optimal_control(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    scope = {}
    exec(next(program for program in PROGRAMS if "vm.control.minimize(" in program), scope)
    assert scope["optimum"].success
    assert abs(scope["optimum"].cost - 6) < 1e-3


def test_a_scheme_of_ones_own(capsys):
    exec("".join(programs("docs/how_to/schemes.md")), {})
    printed = capsys.readouterr().out
    assert "order 2.0" in printed
    (rates,) = re.findall(r"```text\n(.*?)```", (ROOT / "docs/how_to/schemes.md").read_text(), re.DOTALL)
    assert printed.endswith(rates)


def test_derivatives(capsys):
    scope = {}
    exec("".join(programs("docs/how_to/derivatives.md")), scope)
    first, *others = capsys.readouterr().out.splitlines()
    assert others == ["(8,)", "True"]
    squared, params = scope["squared"], scope["params"]
    up, down = (squared({**params, "coupling": 0.1 + d}, {"cart": 0.5}) for d in (1e-5, -1e-5))
    assert float(first.split()[3].rstrip(",")) == pytest.approx(float(up - down) / 2e-5, rel=1e-5)


def test_joint_coordinates(capsys):
    page = (ROOT / "docs/how_to/scenes.md").read_text()
    parts = [part for part in programs("docs/how_to/scenes.md") if "hinge = " in part or "with_joints" in part]
    exec("".join(["import numpy as np\n", *parts]), {})
    assert f"```text\n{capsys.readouterr().out}```" in page


def test_molecules(capsys):
    page = (ROOT / "docs/how_to/molecules.md").read_text()
    first, rigid, steps, many = programs("docs/how_to/molecules.md")
    scope = {}
    exec(first + rigid, scope)
    free, held = capsys.readouterr().out.splitlines()
    assert f"`{free}`" in page
    assert held.startswith("energy kept to 0.1")
    assert abs(scope["length"] - scope["BOND"]).max() < 1e-15
    exec(steps.replace("50 / macro_dt", "2 / macro_dt"), scope)
    assert "macro_dt = 0.0149 is close to an instability" in capsys.readouterr().out
    exec(many.replace("t_end=100.0", "t_end=1.0"), scope)
    assert scope["phi"].shape == (20, 11)
    assert bool(scope["runs"].success.all())


def test_effects_of_ones_own(capsys):
    """A function, then a class, in one namespace: they print what the page says."""
    page = (ROOT / "docs/how_to/effects.md").read_text()
    scope = {"__name__": "effects"}
    for program, shown in zip(
        programs("docs/how_to/effects.md"), re.findall(r"```text\n(.*?)```", page, re.DOTALL), strict=True
    ):
        exec(program, scope)
        assert capsys.readouterr().out == shown


def test_a_run_of_a_scene_is_animated(tmp_path, monkeypatch):
    """The second program of the page on scenes, beside the first one in a file; with a tenth of the steps."""
    scene, animation = programs("docs/how_to/scenes.md")[:2]
    (tmp_path / "my_scene.py").write_text(scene)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    exec(animation.replace("num_steps=300", "num_steps=30"), {})
    assert (tmp_path / "run.html").stat().st_size > 50_000
    assert (tmp_path / "run.png").stat().st_size > 10_000


MADE = ("gallery/", "tutorials/0")
"""Pages that `make docs` writes."""


@pytest.mark.parametrize("path", PAGES, ids=lambda path: str(path.relative_to(ROOT)))
def test_links(path):
    for target in re.findall(r"\]\(([^)#\s]+)", path.read_text()):
        if not target.startswith("http") and not any(part in target for part in MADE) and "_static" not in target:
            assert (path.parent / target).exists(), target


def test_every_public_name_is_documented():
    sys.path.insert(0, str(ROOT / "docs"))
    try:
        from extensions import public  # pyright: ignore[reportMissingImports]
    finally:
        sys.path.pop(0)
    assert public.undocumented() == []
    assert len(public.names("vmri_jax.scene")) > 50
