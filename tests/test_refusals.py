"""Refusals have a class of their own, which the command line and the fuzzer recognise."""

import ast
from pathlib import Path

import pytest

import vmri_jax as vm

PACKAGE = Path(vm.__file__).parent


@pytest.mark.parametrize("builtin", [ValueError, TypeError])
def test_a_refusal_is_caught_as_an_error_of_the_builtin_classes(builtin):
    with pytest.raises(builtin, match="mass must be positive") as caught:
        vm.ConstantMass([-1.0], [1.0])
    assert type(caught.value) is vm.Refused


def test_the_package_raises_refusals_only_by_their_class():
    """A ValueError, TypeError or ImportError that the package raises itself would be shown as a fault of the
    program."""
    raised = [
        (path.name, node.lineno, name.id)
        for path in PACKAGE.rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Raise) and node.exc is not None
        for name in ast.walk(node.exc)
        if isinstance(name, ast.Name) and name.id in ("ValueError", "TypeError", "ImportError")
    ]
    assert not raised, "raise vmri_jax.refusals.Refused, or NotInstalled, in their place"
