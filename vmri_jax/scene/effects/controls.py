"""Controls: forces and torques on bodies and in joints that an optimisation sets, see `vmri_jax.control.minimize`."""

from collections.abc import Callable
from dataclasses import KW_ONLY
from typing import Any, Literal

import jax.numpy as jnp

from vmri_jax.mechanics.arrays import real_array
from vmri_jax.mechanics.names import AXES
from vmri_jax.refusals import Refused
from vmri_jax.scene.body import body_of, end_of, entry, is_entry, label_of, weights_of
from vmri_jax.scene.declare import names, vector
from vmri_jax.scene.effect import Effect
from vmri_jax.scene.effects.joint_base import Joint
from vmri_jax.scene.effects.joint_effects import InJoint
from vmri_jax.scene.terms import Applied, split

Load = Literal["force", "torque"]


def load_on(load: Load, axes: Literal["space", "body"], q, u, params):
    """The generalised force of controls u on a body.

    A force F at the point X puts ``f_i = X_i F`` on the director d_i, a torque M ``f_i = M x d_i / 2``.
    """
    (q,) = q
    u = u * params["along"] / jnp.linalg.norm(params["along"]) if "along" in params else u
    if "point" not in params:
        return (u,)
    _, d = split(q)
    if axes == "body":
        u = u @ d
    if load == "torque":
        return (jnp.concatenate([jnp.zeros(3), (jnp.cross(u, d) / 2).ravel()]),)
    return (jnp.concatenate([u, (params["point"][: len(d), None] * u).ravel()]),)


class Controlled(Effect):
    """A force or a torque that `vmri_jax.control.minimize` sets; in a run it is zero and takes no time.

        Scene([hub, ...], [Controlled("hub", "torque"), Controlled(("hub", [0.5, 0, 0]), "force", along=[0, 1, 0])])

    Args:
        body: name of a body or of a joint, or a point in a rigid body. In a joint the torque acts about its axis and
            the force along it, on b, with the opposite on a.
        load: "force" or "torque"; a torque acts on a rigid body or in a joint.
        along: (d,) the direction of a single control, of any length; by default there is a control for each axis.
        axes: "space", or "body" for the principal axes of inertia of the rigid body, its directors.
    """

    body: Any = names()
    load: Load = "force"
    _: KW_ONLY
    along: Any = vector(default=None)
    axes: Literal["space", "body"] = "space"

    kind = "control"
    whole = True

    def __post_init__(self):
        if not self.name:
            named = is_entry(self.body)
            object.__setattr__(self, "name", f"{label_of(entry(self.body))} {self.load}" if named else str(self.load))
        super().__post_init__()
        for argument, allowed in (("load", ("force", "torque")), ("axes", ("space", "body"))):
            value = getattr(self, argument)
            self.require(value in allowed, argument, repr(value), f"it must be {' or '.join(map(repr, allowed))}")

    def resolved(self, effects):
        """The effect itself, or a `ControlledJoint` if `body` is the name of a joint."""
        if self.body not in [effect.name for effect in effects if isinstance(effect, Joint)]:
            return self
        if self.along is not None:
            raise Refused(f"{self.name}: along is {self.along!r}; a joint has an axis of its own. Leave it out.")
        freedom: Any = "turn" if self.load == "torque" else "slide"
        return ControlledJoint(self.body, of=freedom, name=self.name).resolved(effects)

    @property
    def function(self) -> Callable:
        return Applied(load_on, (self.load, self.axes))

    def _elements(self):
        if not is_entry(self.body):
            raise Refused(f"{self.name}: body is {self.body!r}; give one body or joint, and a Controlled for each.")
        return ((str(entry(self.body)),),)

    def _parameters(self):
        name, params = entry(self.body), {}
        body = body_of(self.by_name, name)
        if self.along is not None:
            params["along"] = self.declared["along"].array(f"{self.name}: along", self.along, [body.point()])
        if body.rigid:
            params["point"] = weights_of(self.by_name, name)
        return params

    def check_bodies(self):
        super().check_bodies()
        name = entry(self.body)
        body = body_of(self.by_name, name)
        end_of(self.by_name, name)  # refuses a point in a body that has none
        if self.along is not None:
            self.require(
                real_array(f"{self.name}: along", self.along).any(), "along", self.along, "it must have a direction"
            )
        directors = body.size // 3 - 1 if body.rigid else 0
        if (self.load == "torque" or self.axes == "body") and directors < 3:
            load = "a torque" if self.load == "torque" else "axes of its own"
            directors_of_body = f"{directors} of three directors" if body.rigid else "no directors"
            raise Refused(f"{self.name}: {name} has {directors_of_body}; {load} needs a rigid body with three.")

    def components(self) -> tuple[str, ...]:
        """Names of the controls."""
        body = body_of(self.by_name, entry(self.body))
        size = body.size if not body.rigid else 3
        if self.along is not None:
            return (self.name,)
        axes = [""] if size == 1 else [f" {axis}" for axis in (AXES if size <= 3 else range(size))][:size]
        return tuple(f"{self.name}{axis}" for axis in axes)


class ControlledJoint(InJoint):
    """The force or torque of `Controlled` in a joint."""

    kind = "control"
    counts_turns = False

    @staticmethod
    def function(q, u, params):
        (x,) = q
        return (u.reshape(x.shape),)

    def check_bodies(self):
        count = len(self.elements)
        self.require(count == 1, f"the number of pairs of {self.joint.name}", count, "give each pair its own joint")

    def components(self) -> tuple[str, ...]:
        """Name of the control."""
        return (self.name,)
