"""What functions of the user read from around them: a run uses what its functions say when it is made.

JAX runs the Python code of a function once and keeps its operations, with the numbers that the function read from
globals, closures or attributes at that time. `Surroundings` are all values that a function reads, as one value that can
be compared: functions of the same code with equal surroundings share their programs, and a changed number, helper or
array makes a new program. `vmri_jax.mechanics.functions` brings them into every program, as the structure of an
argument, which JAX compares at every call.

Code and objects of libraries (Python, installed packages, this package) count as constant, but for objects that can be
called or have no hash. Containers and fields of dataclasses are compared as a whole; attributes of other objects,
classes and modules of the user by the names that occur in the code. Out of sight: `eval`, ``globals()``, and functions
behind a `jax.jit` or a cache of the user, which keep what they read first.
"""

import dataclasses
import dis
import hashlib
import pickle
import sys
from collections import deque
from collections.abc import Callable, Hashable, Mapping
from enum import Enum
from functools import cached_property, lru_cache, partial
from itertools import chain, pairwise
from operator import attrgetter
from pathlib import Path
from types import CodeType, FunctionType, MethodType, ModuleType
from typing import Any

import jax
import numpy as np

from vmri_jax.refusals import Refused

LARGEST_COPIED = 1024
"""Bytes of the largest array that is compared by its numbers; larger arrays are compared by a digest. A larger value
fills the keys of programs with copies of arrays."""
APPENDING = ("append", "extend", "add", "update")
"""Methods that write to a log: a list, set or dictionary before one of them alone is not read."""
LOGS = (list, set, dict, deque)
_NUMBERS = frozenset((bool, int, float, complex))
_CONSTANTS = frozenset((str, bytes, type(None), type(...), CodeType))
_BASES: tuple[Any, ...] = (int, float, complex, str, bytes)
_METHODS = (MethodType, partial, cached_property, property, staticmethod, classmethod)
_INSIDE_METHODS = ("__func__", "__self__", "func", "args", "keywords", "fget")
_MISSING = object()
_unchanged: dict[Hashable, Hashable] = {}
"""Surroundings after functions wrote to them while they were traced (counters, tables filled on demand), and the
surroundings before."""


class Surroundings:
    """A walk through all that a function reads; it enters every object once, so that circles end.

    Attributes:
        key: the code of the function and all that it reads, hashable; equal for equal surroundings.
        have_code: whether there is code of the user.

    Raises:
        ValueError: the function reads a number that a transformation of JAX traces; programs outlive the
            transformation.
    """

    def __init__(self, function: Callable):
        self._function, self._name = function, "a number"
        self._visited: dict[int, tuple[int, Any]] = {}  # with the objects, so that their addresses stay theirs
        self._attributes: dict[str, None] = {}
        self._namespaces: list[Mapping[str, Any]] = []
        self._reads: list[tuple[Callable, tuple, Any]] = []
        self._mutable = self.have_code = False
        key = self._of(function), *self._of_namespaces()
        self.key: Hashable = _unchanged.get(key, key) if _unchanged else key

    def hold(self) -> bool:
        """Whether the function certainly reads the same values, compared by identity: much faster than another walk."""
        return not self._mutable and all(get(*arguments) is value for get, arguments, value in self._reads)

    def before(self, written: "Surroundings") -> None:
        """Count surroundings to which the function itself wrote as these."""
        if written.key != self.key:
            _unchanged[written.key] = self.key

    def _read(self, name: str, get: Callable, *arguments) -> tuple[str, Hashable]:
        """The name and the key of a value that ``get(*arguments)`` has now, noted for `hold`."""
        value = get(*arguments)
        self._reads.append((get, arguments, value))
        self._name = name
        return name, self._of(value)

    def _of(self, value) -> Hashable:
        """A value as a hashable value that is equal for equal values."""
        kind = type(value)
        if kind in _CONSTANTS or value is _MISSING:
            return value
        if kind in _NUMBERS:
            return kind, repr(value)  # 1, 1.0 and True are equal, and so are 0.0 and -0.0
        if id(value) in self._visited:
            return self._visited[id(value)][0]
        self._visited[id(value)] = len(self._visited), value
        if kind is FunctionType:
            return self._of_function(value)
        if isinstance(value, _METHODS):
            own = () if kind in _METHODS else (self._of_object(value),)
            return kind, *own, *(self._of(getattr(value, name)) for name in _INSIDE_METHODS if hasattr(value, name))
        if isinstance(value, Enum):
            return self._of(kind), value.name, self._of(value.value)
        if isinstance(value, _BASES):  # of a class derived from them
            base = next(base for base in _BASES if isinstance(value, base))
            return self._of_object(value), base.__repr__(value)
        if kind is ModuleType or isinstance(value, type):
            return self._of_namespace(value)
        if isinstance(value, (np.ndarray, np.generic, jax.Array)):
            return self._of_array(value)
        if isinstance(value, (Mapping, list, set, deque, tuple, frozenset)):
            self._mutable |= not isinstance(value, (tuple, frozenset))
            return self._of(kind), *map(self._of, list(value.items()) if isinstance(value, Mapping) else value)
        return self._of_object(value)

    def _of_function(self, function: FunctionType) -> Hashable:
        code, cells = function.__code__, function.__closure__ or ()
        of_library = is_of_library(function.__module__)
        if of_library and not cells:
            return function
        around, logs, attributes, imported = names_in(code)
        key = [self._read(name, attrgetter(name), function) for name in ("__code__", "__defaults__", "__kwdefaults__")]
        inside = attrgetter("cell_contents")
        named = zip(code.co_freevars, cells, strict=True)
        cells = [(name, cell) for name, cell in named if not (name in logs and isinstance(inside(cell), LOGS))]
        key += [self._read(name, inside, cell) for name, cell in cells]
        if not of_library:
            self.have_code = True
            self._attributes |= attributes
            self._namespaces += [vars(function)] if vars(function) else []
            there = function.__globals__.get
            around = [name for name in around if not (name in logs and isinstance(there(name), LOGS))]
            key += [self._read(name, there, name, _MISSING) for name in around]
            key += [self._read(name, sys.modules.get, name, _MISSING) for name in imported]
        return tuple(key)

    def _of_array(self, array) -> Hashable:
        if isinstance(array, jax.core.Tracer):  # pyright: ignore[reportAttributeAccessIssue]
            raise Refused(
                f"{name_of(self._function)} reads {self._name}, which jax.grad, jit, vmap or jvp traces, and which is "
                "not among its arguments. Hand it over in the params: System(..., params={'k': k}), and "
                "params['k'] in the function."
            )
        numbers = np.asarray(array if isinstance(array.dtype, np.dtype) else jax.random.key_data(array))
        self._mutable |= not isinstance(array, jax.Array)
        content = self._of(numbers.tolist()) if numbers.dtype.hasobject else numbers.tobytes()
        if numbers.nbytes > LARGEST_COPIED and isinstance(content, bytes):
            content = hashlib.sha256(content).digest()
        return isinstance(array, jax.Array), numbers.dtype.str, numbers.shape, content

    def _of_namespace(self, value) -> Hashable:
        """A module or class.

        Attributes of those of the user follow by name, but for operators of classes, which Python calls without names.
        """
        if is_of_library(value.__name__ if isinstance(value, ModuleType) else value.__module__):
            return value
        self._namespaces.append(vars(value))
        if isinstance(value, ModuleType):
            return value.__name__
        # dataclasses writes its methods from text
        methods = {name: item.__code__.co_filename for name, item in vars(value).items() if type(item) is FunctionType}
        operators = [name for name, file in methods.items() if name.startswith("__") and file != "<string>"]
        key = [self._read(name, vars(value).get, name) for name in operators]
        return value.__qualname__, *map(self._of, value.__bases__), *key

    def _of_object(self, value) -> Hashable:
        """An object by its fields and attributes; an object of a library by itself, unless it can be called or has no
        hash."""
        kind, inside = type(value), getattr(value, "__dict__", None)
        is_data = dataclasses.is_dataclass(kind)
        if is_of_library(kind.__module__) and not is_data:
            if kind.__hash__ is not None and not (callable(value) and inside):
                return value
            if hasattr(value, "__array__"):  # a table of pandas or xarray, whose numbers change in place
                self._mutable = True
                return kind, hashlib.sha256(pickle.dumps(value)).digest()
            if inside is not None:
                return kind, *(self._read(name, inside.get, name, _MISSING) for name in list(inside))
            self._mutable = True
            return kind, repr(value)
        names = [name for base in kind.__mro__ for name in getattr(base, "__slots__", ()) if hasattr(value, name)]
        if is_data:
            names = [field.name for field in dataclasses.fields(kind)]
        else:
            self._namespaces.append(inside or {})
        return self._of(kind), *(self._read(name, getattr, value, name, _MISSING) for name in names)

    def _of_namespaces(self) -> list[Hashable]:
        """Attributes of modules, classes and objects of the user, by all names in the code of functions; both grow on
        the way."""
        key: list[Hashable] = []
        old = 0, 0
        while old != (size := (len(self._namespaces), len(self._attributes))):
            names = list(self._attributes)
            for number, namespace in enumerate(self._namespaces[: size[0]]):
                new = names if number >= old[0] else names[old[1] :]
                key += [self._read(name, namespace.get, name, _MISSING) for name in new]
            old = size
        return key


@lru_cache(maxsize=4096)
def names_in(code: CodeType) -> tuple[tuple[str, ...], frozenset[str], dict[str, None], tuple[str, ...]]:
    """Names that code reads, with the functions inside of it: globals, names of globals and cells that stand before
    `APPENDING` alone, attributes, also those in texts for `getattr`, and modules that the code itself imports."""
    inner = [names_in(constant) for constant in code.co_consts if isinstance(constant, CodeType)]
    texts = [text for text in code.co_consts if isinstance(text, str) and text.isidentifier()]
    pairs = [(now, after.argval in APPENDING) for now, after in pairwise(dis.get_instructions(code))]
    around = [now.argval for now, _ in pairs if "GLOBAL" in now.opname or now.opname == "LOAD_NAME"]
    named = [(now.argval, is_log) for now, is_log in pairs if "DEREF" in now.opname or now.argval in around]
    modules = [now.argval for now, _ in pairs if now.opname == "IMPORT_NAME"]
    globals_inside, logs_inside, attributes_inside, modules_inside = zip(*inner, strict=True) if inner else ((),) * 4
    logs, others = ({name for name, is_log in named if is_log == kind} for kind in (True, False))
    return (
        tuple(dict.fromkeys([*around, *chain(*globals_inside)])),
        frozenset(logs.union(*logs_inside) - others),
        dict.fromkeys([*code.co_names, *texts, *chain(*attributes_inside)]),
        tuple(dict.fromkeys([*modules, *chain(*modules_inside)])),
    )


@lru_cache(maxsize=4096)
def is_of_library(module: str | None) -> bool:
    """Whether a module belongs to Python, to an installed package or to this package."""
    top = (module or "").partition(".")[0]
    file = getattr(sys.modules.get(top), "__file__", None) or ""
    is_installed = not {"site-packages", "dist-packages"}.isdisjoint(Path(file).parts)
    return is_installed or top in sys.stdlib_module_names or top == __name__.partition(".")[0]


def name_of(function) -> str:
    """The name of a function of a system; the name of its class if the function has none."""
    function = innermost(function)
    return getattr(function, "__name__", type(function).__name__)


def innermost(function) -> Any:
    """The function as the user wrote it, out of `TracedOnce`, `Rheonomic` and `ByName`."""
    while hasattr(function, "function"):
        function = function.function
    return function
