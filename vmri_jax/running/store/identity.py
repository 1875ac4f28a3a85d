"""The identity of a run: functions, parameters, scheme, step and start as text, so that a run can be compared with the
run of a store."""

import dataclasses
import json
import os
import platform
from importlib.metadata import version
from pathlib import Path

import jax
import numpy as np

from vmri_jax.mechanics.checks import digest, operations
from vmri_jax.mechanics.functions import TracedOnce
from vmri_jax.mechanics.masses import ConstantMass
from vmri_jax.mechanics.terms import KINDS, Named
from vmri_jax.refusals import Refused, warn_user
from vmri_jax.running.simulation import Simulation

MOST_NUMBERS_PRINTED = 8
"""Numbers of the largest array that is written out in the identity; larger arrays appear as a digest. A larger value
makes messages about different runs longer."""


def identity(run: Simulation) -> dict[str, str]:
    """Everything that determines a run, as text by name.

    A function is identified by its name and by a digest of the operations that it traces to: a changed body with the
    same name makes another run.
    """
    system, start, texts = run.system, run.state, {"solver": type(run.solver).__name__}
    for name in ("scheme", "solver", "macro_dt", "save_every"):
        texts |= describe(name, getattr(run, name))
    for name in (*KINDS, "params"):
        texts |= describe(f"system.{name}", getattr(system, name))
    texts |= describe("save_micro", run.save.micro) | describe("state", start)
    values = {"t": start.t, "q_s": start.q_s, "q_f": start.q_f, "v_s": start.q_s, "v_f": start.q_f}
    for term in system.terms:
        if not isinstance(term.function, ConstantMass):
            of_term = operations(term.function, *term.of_arguments(values), system.params)
            texts[f"operations of {term.place}"] = of_term
    return texts


def package_versions() -> dict[str, str]:
    """Versions of the packages on which the last digits of a run depend."""
    return {name: version(name) for name in ("vmri_jax", "jax", "jaxlib")}


def environment() -> dict[str, str]:
    """Versions, machine and compiler flags, on which the last digits of a run depend."""
    flags = os.environ.get("XLA_FLAGS", "")
    return package_versions() | {"machine": f"{platform.system()} {platform.machine()}", "XLA_FLAGS": flags}


def check_same(path: Path, attributes: dict, stored: dict, chunk: int | None, complete: bool) -> None:
    """Refuse to go on with the store of another run; warn if its environment was another one, unless it is complete.

    `attributes` are of the store that the user wants, `stored` of the store on disk; `chunk` is the user's, or None.
    Operations are compared only if both were made with the same version of JAX: another version prints them
    differently.
    """
    kind = stored["kind"]
    # a column of the store has the name of its coordinate
    here, there = (
        a["identity"] | describe("names", json.loads(json.dumps(a.get("names")))) for a in (attributes, stored)
    )
    now, then = attributes["made_with"], stored["made_with"]
    names = [name for name in {**here, **there} if here.get(name) != there.get(name)]
    if now["jax"] != then["jax"]:
        names = [name for name in names if not name.startswith("operations of ")]
    changes = [f"{name}: {here.get(name, 'none')} here, {there.get(name, 'none')} in the store" for name in names]
    if chunk not in (None, stored["chunk"]):
        changes.append(f"chunk: {chunk} here, {stored['chunk']} in the store")
    if changes:
        other = f"{path} holds another {kind} and cannot go on with this one. Differences: {'; '.join(changes)}"
        raise Refused(f"{other}. Give the arguments it was started with, or another name.")
    changed = [f"{name} {value} ({then.get(name)} then)" for name, value in now.items() if value != then.get(name)]
    if changed and not complete:
        warn_user(
            f"{path} was started under other conditions; its last digits may differ from those of an uninterrupted "
            f"{kind}. Now: {', '.join(changed)}.",
        )


def describe(name: str, value) -> dict[str, str]:
    """All leaves of a value as text, by the path to each leaf, which begins with `name`."""
    if dataclasses.is_dataclass(value) and not isinstance(value, TracedOnce):
        parts = {f"{name}.{field.name}": getattr(value, field.name) for field in dataclasses.fields(value)}
    elif isinstance(value, Named) and not any(isinstance(part, TracedOnce) for part in value.values()):  # rules
        parts = {f"{name}[{key!r}]": part for key, part in value.items()}
    else:
        value = tuple(value.items()) if isinstance(value, Named) else value  # functions, with their names
        leaves, _ = jax.tree_util.tree_flatten_with_path(value, is_leaf=lambda leaf: isinstance(leaf, TracedOnce))
        return {name + jax.tree_util.keystr(path): _text(leaf) for path, leaf in leaves}
    return {key: text for name, part in parts.items() for key, text in describe(name, part).items()}


def _text(leaf) -> str:
    if isinstance(leaf, TracedOnce):
        leaf = leaf.function
    if callable(leaf):
        return f"{getattr(leaf, '__module__', '')}.{getattr(leaf, '__qualname__', type(leaf).__name__)}"
    if isinstance(leaf, str | bool):
        return str(leaf)
    array = np.asarray(leaf)
    if array.size <= MOST_NUMBERS_PRINTED:
        return str(array.tolist())
    return f"{array.dtype}{array.shape}, digest {digest(array.tobytes())}"
