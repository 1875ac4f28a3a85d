"""`vmri new`: a commented file with a system or a scene, which the user changes."""

from importlib.resources import files
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from vmri_jax.cli.common import check_target_file, console

FILE = Path("my_system.py")


def new(
    file: Annotated[Path, typer.Argument(help="Where to write it, a .py.")] = FILE,
    scene: Annotated[bool, typer.Option("--scene", help="Bodies and effects instead of functions.")] = False,
) -> None:
    """Write a commented program that runs, to change into your own system or scene."""
    check_target_file("FILE", file, (".py",))
    if file.exists():
        raise FileExistsError(f"{file} exists already; give another name.")
    kind = "scene" if scene else "system"
    text = files("vmri_jax.cli").joinpath(f"new_{kind}.py.txt").read_text(encoding="utf-8")
    file.write_text(text.replace("FILE", file.as_posix()), encoding="utf-8")
    thing = "scene" if scene else "problem"
    commands = f"python {file}", f"vmri simulate {file}:{thing} --macro-dt 0.02 --steps 200 --out run.npz"
    console.print(f"wrote [bold]{escape(str(file))}[/bold]; these commands run it:", soft_wrap=True)
    for command in commands:
        console.print(f"    {escape(command)}", soft_wrap=True)
