"""A self-contained page: the motion as packed numbers, and a script that draws it on a canvas."""

import base64
from pathlib import Path

import jinja2
import numpy as np

from vmri_jax import plots
from vmri_jax.animation.drawing import Drawing
from vmri_jax.animation.geometry import JOINT_END, LAMP, helix
from vmri_jax.animation.layout import Layout, layout, nice
from vmri_jax.animation.motion import Motion
from vmri_jax.animation.parts import Joint
from vmri_jax.running.files import check_place

MOST_COORDINATES = 600_000
"""Largest number of coordinates of bodies in a page, about 6 MB; of longer runs the page has every k-th node."""
PLAY_SECONDS = 20.0
"""Target seconds to watch a run at the first speed; runs of about this length play in real time."""


def write_html(motion: Motion, path: str | Path, title: str = "") -> None:
    """Write one HTML file that shows the motion in a browser: no network, nothing to install.

    ``page.html#t=3.5`` opens the page stopped at that time, ``#theme=dark`` in dark colours.

    Args:
        motion: from `vmri_jax.animation.motion`.
        path: of the file.
        title: over the picture.

    Raises:
        OSError: the file cannot be written.
    """
    every = -(-motion.points.size // MOST_COORDINATES)
    drawing, sizes = motion.drawing, layout(motion)
    coloured = {drawing.pace(joint) for joint in drawing.joints if joint.kind == "spring"}
    coloured |= {body.pace for body in drawing.bodies if body.color is None and body.shown}
    data = _data(motion.thinned(-(-len(motion.t) // every)), sizes)
    if every > 1:
        ending = {2: "nd", 3: "rd"}.get(every, "th")
        data["caption"] = f"{drawing.caption} Drawn from every {every}{ending} node.".strip()
    loader = jinja2.PackageLoader("vmri_jax.animation", "page")
    environment = jinja2.Environment(loader=loader, autoescape=True, trim_blocks=True, lstrip_blocks=True)
    environment.policies["json.dumps_kwargs"] = {"default": np.ndarray.tolist}
    text = environment.get_template("page.html.j2").render(
        title=title or "Motion",
        description=_description(motion),
        paces=sorted(coloured, reverse=True),
        constrained=data["residual"] is not None,
        data=data,
        light=plots.LIGHT,
        dark=plots.DARK,
    )
    check_place(Path(path))
    Path(path).write_text(text, encoding="utf-8")


def _data(motion: Motion, sizes: Layout) -> dict:
    """The data of the script, with the names that its files use."""
    drawing, t = motion.drawing, motion.t
    duration = float(t[-1] - t[0])
    speed = (
        1.0 if 0.15 * PLAY_SECONDS <= duration <= 3 * PLAY_SECONDS or duration == 0 else nice(duration / PLAY_SECONDS)
    )
    lines = [_line(drawing, *line) for line in zip(drawing.joints, sizes.turns, strict=True)]
    turns = {line["turns"] for line in lines if line["kind"] == "spring"}
    many = len(lines) > 20  # fewer points then: the script draws every helix in every picture
    constrained = bool(np.nanmax(motion.residual, initial=0.0) > 0)
    title = f"{motion.energy_names[0]} {'ΔE / |E₀|' if motion.relative else 'ΔE'}"
    return {
        "t": _packed(t, np.float64),
        "points": _packed(motion.points),
        "velocities": _packed(motion.velocities),
        "energy": [_packed(column) for column in motion.energy.T],
        "energy_names": motion.energy_names if len(motion.energy_names) > 1 else [""],
        "energy_title": title if len(motion.energy_names) == 1 else "since the start:",
        "residual": [_packed(column) for column in motion.residual.T] if constrained else None,
        "bodies": [
            {"name": body.name, "pace": body.pace, "color": body.color, "radius": float(radius), "shown": body.shown}
            for body, radius in zip(drawing.bodies, sizes.radii, strict=True)
        ],
        "solids": [
            vars(solid) | {"points": [drawing.numbers[name] for name in solid.points]} for solid in drawing.solids
        ],
        "connections": lines,
        "planes": [vars(ground) | {"grid": _packed(ground.grid), "bears": ground.bears} for ground in sizes.grounds],
        "spheres": [{"center": c, "radius": r} for c, r in zip(sizes.spheres, sizes.sphere_radii, strict=True)],
        "helices": {n: helix(n, 10 if many else 16) for n in turns},
        "lamp": LAMP,
        "span": JOINT_END,
        "size": sizes.size,
        "rod": sizes.rod,
        "coil": sizes.coil,
        "wire": sizes.wire,
        "view": {"azimuth": sizes.azimuth, "elevation": sizes.elevation},
        "fitted": sizes.hull,
        "margin": float(sizes.radii.max()),
        "trails": any(
            sum(map(bool, body.forms)) > 1 for body in drawing.bodies if body.shown
        ),  # a trail along a line would show nothing
        "speed": speed,
        "speeds": [float(f"{speed * factor:.1g}") for factor in (0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10)],
        "caption": drawing.caption,
        "ending": motion.ending,
    }


def _line(drawing: Drawing, joint: Joint, turns: int) -> dict:
    """A link or spring from a body, by its number, to another body, or to a fixed point in the picture."""
    body, *other = (drawing.numbers[name] for name in joint.bodies)
    point = None if joint.point is None else drawing.place([joint.point])[0]
    line = {"kind": joint.kind, "body": body, "other": next(iter(other), None), "point": point}
    return line | {"pace": drawing.pace(joint), "turns": turns}


def _packed(array: np.ndarray, dtype: type = np.float32) -> str:
    """Little-endian bytes in base 64."""
    return base64.b64encode(np.ascontiguousarray(array, dtype=np.dtype(dtype).newbyteorder("<")).tobytes()).decode()


def _description(motion: Motion) -> str:
    drawing = motion.drawing
    names = [body.name for body in drawing.bodies if body.shown]
    kinds = [joint.kind if joint.point is None else "fixed point" for joint in drawing.joints]
    counts = {kind: kinds.count(kind) for kind in ("link", "spring", "fixed point")}
    joints = [f"{count} {name}{'s' if count > 1 else ''}" for name, count in counts.items() if count]
    bodies = f"{len(names)} bodies" if len(names) > 6 else ", ".join(names)
    return f"Animation of {', '.join([bodies, *joints])} from t = {motion.t[0]:g} to {motion.t[-1]:g}."
