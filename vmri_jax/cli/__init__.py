"""The command line ``vmri``: systems, schemes, one run, many runs, the cost of accuracy, hard cases.

This file joins the commands of the modules into one app.
"""

import os

import jax
import typer

from vmri_jax.cli import lists, run, scenes, stability, study
from vmri_jax.cli.animate import animate
from vmri_jax.cli.check import check
from vmri_jax.cli.common import MANY, RIGHT, RUN
from vmri_jax.cli.new import new
from vmri_jax.cli.sweep import sweep
from vmri_jax.configure import configure

app = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode="rich",
    pretty_exceptions_show_locals=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
app.command(rich_help_panel=RUN)(new)
for part in (run, stability, scenes, study, lists):
    app.add_typer(part.app)
app.command(rich_help_panel=RUN)(animate)
app.command(rich_help_panel=RIGHT)(check)
app.command(rich_help_panel=MANY)(sweep)


def main() -> None:
    """Entry point."""
    configure()
    app()


@app.callback()
def start() -> None:
    """Variational multirate integrators: simulate stiff mechanical systems, slow and fast parts at their own step."""
    jax.config.update("jax_enable_x64", True)
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # matrices here are small: threads only make times scatter
