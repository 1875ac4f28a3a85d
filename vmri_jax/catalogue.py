"""Systems and schemes by name: the built-in ones, and problems from a user's own file or package."""

import importlib
import importlib.util
import inspect
import sys
import traceback
from collections.abc import Callable
from pathlib import Path

from vmri_jax import systems
from vmri_jax.mechanics.names import near, unknown
from vmri_jax.mechanics.state import Problem
from vmri_jax.refusals import Refused
from vmri_jax.scene import Scene
from vmri_jax.schemes import composition
from vmri_jax.schemes.composition import Composition
from vmri_jax.schemes.scheme import (
    Scheme,
    explicit_slow,
    fully_explicit,
    fully_implicit,
    galerkin,
    mollified_impulse,
    takahashi_imada,
)

SYSTEMS = {
    "fpu": systems.fermi_pasta_ulam,
    "tsp": systems.triple_spherical_pendulum,
    "sam": systems.simple_atomic_model,
}
"""The built-in systems."""

DEFAULT_NAMES = ("scene", "problem")
"""Names that are taken, in this order, from a file with several problems if the user names only the file."""

SCHEMES: dict[str, Callable[..., Scheme]] = {
    scheme.__name__.replace("_", "-"): scheme
    for scheme in (fully_implicit, explicit_slow, mollified_impulse, fully_explicit, takahashi_imada, galerkin)
}
"""The built-in schemes."""


def options_of(scheme: Callable[..., Scheme]) -> list[str]:
    """Names of the arguments of a scheme besides num_micro."""
    return [name for name in inspect.signature(scheme).parameters if name != "num_micro"]


MODELS = (".xml", ".mjcf", ".urdf")
"""Endings of the files that MuJoCo reads."""


def find_problem(name: str) -> Problem:
    """A problem by name: a built-in one, ``my_file.py:my_problem``, ``my_package.my_module:my_problem`` of an installed
    package, or a model of MuJoCo, ``model.xml``.

    The name in the file stands for a `Problem`, a `Scene`, or a function without arguments that returns one of these. A
    file name alone, ``my_file.py``, stands for the only problem in the file; in a file with several it stands for
    ``scene`` or ``problem``, and a line on the error stream tells which one is taken.

    Raises:
        ValueError: an unknown name; a file that does not exist, fails to run, or lacks the name; a value that is no
        problem.
    """
    scene_or_problem = find_scene_or_problem(name)
    try:
        return scene_or_problem.problem() if isinstance(scene_or_problem, Scene) else scene_or_problem
    except Exception as error:
        raise Refused(f"{name} is a scene that makes no system: {type(error).__name__}: {error}") from error


def find_scene_or_problem(name: str) -> Scene | Problem:
    """The scene with this name, from which `find_problem` makes a problem, or the problem where there is no scene.

    Raises:
        ValueError: as in `find_problem`.
    """
    if name in SYSTEMS:
        return SYSTEMS[name]()
    where, colon, attribute = name.partition(":")
    if Path(name).suffix.lower() in MODELS:
        try:
            return Scene.from_mujoco(name)
        except ImportError as error:
            raise Refused(str(error)) from error
    is_module = colon and all(part.isidentifier() for part in where.split("."))
    if not (is_module or where.endswith(".py")):
        raise Refused(
            f"{unknown('system', name, SYSTEMS)} Your own: my_file.py:my_problem, or my_package.my_module:my_problem."
        )
    module = _module(where)
    return _problem_in(module, str(Path(where)), attribute or _only_name(module, where))


def _only_name(module, file_name: str) -> str:
    """The name that a file name alone stands for; a line on the error stream names the other problems of the file."""
    names = _problems_in(module)
    named = [name for name in DEFAULT_NAMES if hasattr(module, name)]
    if len(names) == 1 and not named:
        return names[0]
    if not named:
        listed = (
            f"it has {', '.join(f'{file_name}:{name}' for name in names)}" if names else f"e.g. {file_name}:my_problem"
        )
        raise Refused(f"{file_name}: say which problem in that file; {listed}.")
    not_taken = [f"{file_name}:{name}" for name in names if name != named[0]]
    if not_taken:
        print(f"{file_name}: taking {named[0]}; there is also {', '.join(not_taken)}.", file=sys.stderr)
    return named[0]


def _problems_in(module) -> list[str]:
    """Names of the problems and scenes in a module, imported names included."""
    return [name for name, value in vars(module).items() if isinstance(value, Problem | Scene) and name[0] != "_"]


def find_scheme(name: str, num_micro: int, compose: str | None = None, **options) -> Scheme | Composition:
    """A built-in scheme by name, with dashes or underscores; options that are None keep their defaults.

    Args:
        name: one of `SCHEMES`.
        num_micro: micro steps per macro step.
        compose: name of the composition of the scheme, see `vmri_jax.compose`; None for the scheme alone.
        options: alpha, degree, rule, where the scheme has them.

    Raises:
        ValueError: an unknown name, an option that the scheme does not have, or no degree for galerkin.
    """
    scheme = SCHEMES.get(name.lower().replace("_", "-"))
    if scheme is None:
        raise Refused(unknown("scheme", name, SCHEMES))
    arguments = {key: value for key, value in options.items() if value is not None}
    for key in arguments:
        if key not in options_of(scheme):
            takers = [label for label, other in SCHEMES.items() if key in options_of(other)]
            raise Refused(f"the scheme {name} has no {key}; leave --{key} out or use {' or '.join(takers)}.")
    if scheme is galerkin and "degree" not in arguments:
        raise Refused("the scheme galerkin needs the degree of its path; give e.g. --degree 2.")
    made = scheme(num_micro, **arguments)
    return made if compose is None else composition.compose(made, compose)


def _run_file(file_name: str):
    """The module of a Python file of the user."""
    path = Path(file_name)
    if not path.is_file():
        raise Refused(f"the file {file_name} does not exist (looked in {path.resolve().parent}).")
    name = f"vmri_user_{path.stem}"  # not the bare stem, which may be the name of a module
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise Refused(f"{path} is not a Python file; give my_file.py:my_problem.")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses and equinox modules look themselves up there
    sys.path.insert(0, str(path.resolve().parent))
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:
        lines = [f.lineno for f in traceback.extract_tb(error.__traceback__) if Path(f.filename).name == path.name]
        where = f"line {lines[-1]} of {path}" if lines else f"{path}"
        raise Refused(f"{where} failed: {type(error).__name__}: {error}") from error
    finally:
        sys.path.pop(0)
    return module


def _module(name: str):
    """The module of a file of the user, or of a package that is installed."""
    if name.endswith(".py"):
        return _run_file(name)
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise Refused(
            f"the module {name} cannot be imported ({error}); install its package, or give the file, "
            "my_file.py:my_problem."
        ) from error


def imported(name: str):
    """The value of ``my_file.py:name`` or ``my_package.my_module:name``.

    Raises:
        ValueError: the file or package does not exist, or does not have the name.
    """
    where, _, attribute = name.partition(":")
    return _attribute(_module(where), where, attribute)


def _attribute(module, where: str, attribute: str):
    """A public value of a module; `where` names the module in messages."""
    public = {name: value for name, value in vars(module).items() if not name.startswith("_")}
    if attribute not in public:
        problems = _problems_in(module)
        listed = f" Problems in it: {', '.join(problems)}." if problems else ""
        raise Refused(f"{where} has no name {attribute!r}.{near(attribute, public)}{listed}")
    return public[attribute]


def _problem_in(module, path: str, attribute: str) -> Problem | Scene:
    """The problem or scene with this name in a module; functions are called."""
    problem = _attribute(module, path, attribute)
    if callable(problem) and not isinstance(problem, Problem | Scene):
        try:
            problem = problem()
        except Exception as error:
            raise Refused(f"{attribute}() in {path} failed: {type(error).__name__}: {error}") from error
    if not isinstance(problem, Problem | Scene):
        raise Refused(
            f"{attribute} in {path} is {type(problem).__name__}; it must be a vmri_jax.Problem, or a function without "
            "arguments that returns one; a vmri_jax.scene.Scene will do as well."
        )
    return problem
