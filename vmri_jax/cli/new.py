"""`vmri new`: a commented file with a system, a scene or a sweep, which the user changes."""

from importlib.resources import files
from pathlib import Path
from typing import Annotated

from rich.markup import escape
from typer import Argument, Option

from vmri_jax.cli.common import check_target, console


def new(
    file: Annotated[Path, Argument(help="Where to write it: a .py, or a .toml for a sweep.")] = Path("my_system.py"),
    scene: Annotated[bool, Option("--scene", help="Bodies and effects instead of functions.")] = False,
) -> None:
    """Write a commented program that runs, to change into your own system or scene, or the file of a sweep."""
    check_target("FILE", file, ".py", ".toml")
    if file.exists():
        raise FileExistsError(f"{file} exists already; give another name.")
    if file.suffix.lower() == ".toml":
        template, commands = "sweep.toml", [f"vmri sweep {file} --workers 2"]
    else:
        kind, thing = ("scene", "scene") if scene else ("system", "problem")
        template = f"new_{kind}.py.txt"
        run = f"vmri simulate {file}:{thing} --macro-dt 0.02 --steps 200 --out run.npz"
        commands = [f"python {file}", run]
    text = files("vmri_jax.cli").joinpath(template).read_text(encoding="utf-8")
    file.write_text(text.replace("FILE", file.as_posix()), encoding="utf-8")
    console.print(f"wrote [bold]{escape(str(file))}[/bold]; run it with:", soft_wrap=True)
    for command in commands:
        console.print(f"    {escape(command)}", soft_wrap=True)
