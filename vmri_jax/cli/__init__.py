"""The command line ``vmri``: systems, schemes, one run, many runs, the cost of accuracy, hard cases.

This file joins the commands of the modules into one app.
"""

import os

import jax
import typer

from vmri_jax.cli.animate import animate
from vmri_jax.cli.common import refusals
from vmri_jax.cli.lists import new, schemes, systems
from vmri_jax.cli.right import advise, check, explain, stability
from vmri_jax.cli.run import simulate
from vmri_jax.cli.study import cost, tune
from vmri_jax.cli.sweep import sweep
from vmri_jax.configure import configure

COMMANDS = {
    "Run and see:  vmri simulate fpu --macro-dt 0.05 --steps 400 --out run.npz": (new, simulate, animate),
    "Is it right:  vmri check my_system.py:problem": (advise, stability, explain, check),
    "What it costs:  vmri tune fpu --error 1e-4 --t-end 2": (tune, cost),
    "Many runs, and what there is:  vmri new sweep.toml": (systems, schemes, sweep),
}
"""The commands by the title of their group in the help of `vmri`, which has an example."""

app = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode="rich",
    pretty_exceptions_show_locals=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
for title, commands in COMMANDS.items():
    for command in commands:
        app.command(rich_help_panel=title)(refusals()(command))  # a command shows refusals wherever they come from


def main() -> None:
    """Entry point."""
    configure()
    app()


@app.callback()
def start() -> None:
    """Variational multirate integrators: simulate stiff mechanical systems, slow and fast parts at their own step."""
    jax.config.update("jax_enable_x64", True)
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # matrices here are small: threads only make times scatter
