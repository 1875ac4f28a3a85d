"""Schemes and compositions as plain data for JSON: dictionaries, lists, texts and numbers."""

from typing import Any

import numpy as np

from vmri_jax.refusals import Refused
from vmri_jax.schemes.composition import Composition
from vmri_jax.schemes.description import RULES
from vmri_jax.schemes.quadrature import PlacedRule, Rule
from vmri_jax.schemes.scheme import Scheme

PLACEMENT = ("grid", "mollified", "gradient_corrected", "every")
"""Fields of a placed rule besides the rule."""


def to_plain(scheme: Scheme | Composition) -> dict[str, Any]:
    """A scheme with concrete weights as plain data; numbers of float64 stay the same through JSON."""
    if isinstance(scheme, Composition):
        return {"scheme": to_plain(scheme.scheme), "coefficients": np.asarray(scheme.coefficients).tolist()}
    rules = {name: _plain_rule(getattr(scheme, name)) for name in RULES.values()}
    # pairs, since a potential may have a whole number as its name, which keys of JSON cannot be
    potentials = [[name, _plain_rule(placed)] for name, placed in scheme.potentials.items()]
    return {"num_micro": scheme.num_micro, "degree": scheme.degree, **rules, "potentials": potentials}


def from_plain(data: dict[str, Any]) -> Scheme | Composition:
    """The inverse of `to_plain`, also after a round trip through JSON.

    Raises:
        KeyError, TypeError, ValueError: data that are no scheme.
    """
    if "coefficients" in data:
        scheme = from_plain(data["scheme"])
        if isinstance(scheme, Composition):
            raise Refused("from_plain: the stages of a composition must be steps of a scheme, not of a composition.")
        return Composition(scheme, np.asarray(data["coefficients"]))
    rules = {name: _placed_rule(data[name]) for name in RULES.values()}
    potentials = {name: _placed_rule(placed) for name, placed in data["potentials"]}
    return Scheme(data["num_micro"], data["degree"], **rules, potentials=potentials)


def _plain_rule(placed: PlacedRule) -> dict[str, Any]:
    """A rule with its grid."""
    rule = {"nodes": list(placed.rule.nodes), "weights": np.asarray(placed.rule.weights).tolist()}
    return rule | {name: getattr(placed, name) for name in PLACEMENT}


def _placed_rule(data: dict[str, Any]) -> PlacedRule:
    """The inverse of `_plain_rule`."""
    return PlacedRule(Rule(data["nodes"], np.asarray(data["weights"])), **{name: data[name] for name in PLACEMENT})
