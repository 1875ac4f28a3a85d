"""Self-contained HTML pages in one style, with embedded figures for light and dark screens, and a footer that names the
machine."""

import base64
import os
import platform
from collections.abc import Callable
from datetime import datetime
from importlib.metadata import version
from io import BytesIO
from pathlib import Path

import jax
import jinja2
from matplotlib.figure import Figure

from vmri_jax import plots


def write_page(path: Path, template: Path, **values) -> None:
    """Render a template to `path`.

    The template may include ``style.css``; it gets `values`, and date, machine and versions.
    """
    threads = os.environ.get("OPENBLAS_NUM_THREADS", "all")
    algebra = f"linear algebra on {threads} {'thread' if threads == '1' else 'threads'}"
    loader = jinja2.FileSystemLoader([template.parent, Path(__file__).parent])
    environment = jinja2.Environment(loader=loader, autoescape=True, trim_blocks=True, lstrip_blocks=True)
    text = environment.get_template(template.name).render(
        date=datetime.now().strftime("%-d %B %Y, %H:%M"),
        machine=(
            f"{processor()}, {os.cpu_count()} cores, {platform.system()}, JAX on {jax.default_backend()}, {algebra}"
        ),
        versions=f"vmri_jax {version('vmri_jax')}, JAX {jax.__version__}, Python {platform.python_version()}",
        **values,
    )
    path.write_text(text, encoding="utf-8")


def processor() -> str:
    """Name of the processor."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), platform.machine())


def embedded(draw: Callable[[plots.Theme], Figure]) -> tuple[str, str]:
    """A figure as two data URLs, the light one and the dark one."""
    urls = []
    for theme in (plots.LIGHT, plots.DARK):
        buffer = BytesIO()
        with plots.style(theme):
            draw(theme).savefig(buffer, format="svg", metadata={"Date": None})
        urls.append(f"data:image/svg+xml;base64,{base64.b64encode(buffer.getvalue()).decode()}")
    return urls[0], urls[1]
