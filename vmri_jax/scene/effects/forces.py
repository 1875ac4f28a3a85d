"""Fields and forces: gravity on masses, a magnetic field on charges; forces that are constant, functions of time, or
turn with two bodies; forces against motion: linear damping, quadratic drag, dashpots between points, Rayleigh
damping."""

from collections.abc import Callable
from dataclasses import field, replace
from typing import Any

import jax.numpy as jnp
import numpy as np

from vmri_jax.mechanics.names import unknown
from vmri_jax.refusals import Refused
from vmri_jax.scene.declare import array, common, names, number, of_time, positive, vector
from vmri_jax.scene.effect import Effect
from vmri_jax.scene.effects.springs import BetweenPoints
from vmri_jax.scene.terms import ARGUMENTS, Applied, TangentDamping, joined, stiffness_times


class Gravity(Effect):
    """Uniform gravity, ``V = -sum_i m_i g . q_i``.

    Args:
        acceleration: g, (d,) m/s^2; a number g is that acceleration downwards, along the last axis: (0, ..., -g).
        bodies: names of bodies with one mass each; all bodies of the scene by default.
    """

    acceleration: Any = common(default=9.81, may_be_number=True)
    bodies: Any = names(default=None)

    kind = "potential"
    masses = ("mass",)

    @staticmethod
    def function(q, params):
        (q,), g = q, params["acceleration"]
        if jnp.ndim(g) == 0:
            return g * jnp.sum(params["mass"] * q[..., -1])
        return -jnp.sum(params["mass"] * jnp.sum(g * q, axis=-1))

    def drawing(self):
        up = -np.asarray(self.acceleration, dtype=float)
        return {"up": up.tolist()} if up.ndim and up.any() else {}


class MagneticField(Effect):
    """Charges in a uniform magnetic field: ``L = sum Q v . A(q)``, ``A = B x q / 2``, hence the force ``Q v x B``.

    It depends on velocities, so that momenta are ``p = m v + Q A``.

    Args:
        field: B, T, (3,); for bodies in the plane a number, the component out of it.
        charge: Q, C; one number, or one for each body.
        bodies: names; all bodies of the scene by default.
    """

    field: Any = array()
    charge: Any = number()
    bodies: Any = names(default=None)

    kind = "kinetic"
    default_name = "magnetic_field"
    dimensions = (2, 3)

    @staticmethod
    def function(q, v, params):
        (q,), (v,), field = q, v, params["field"]
        if jnp.ndim(field) == 0:
            swept = field * (q[..., 0] * v[..., 1] - q[..., 1] * v[..., 0])
        else:
            swept = jnp.sum(v * jnp.cross(jnp.broadcast_to(field, q.shape), q), axis=-1)
        return jnp.sum(params["charge"] / 2 * swept)

    def check_parameters(self):
        super().check_parameters()
        shape = self.parameters["field"].shape
        for (end,) in self.ends:
            if shape != (() if end.size == 2 else (3,)):
                raise Refused(
                    f"{self.name}: field has shape {shape} and {end.name} has dimension {end.size}; give a number in "
                    "the plane, a vector (3,) in space."
                )


class ConstantForce(Effect):
    """A constant force f on bodies.

    Args:
        bodies: a name, or a list of names.
        force: f, N, (d,); or one for each body, (n, d).
    """

    bodies: Any = names()
    force: Any = vector()

    kind = "force"
    default_name = "constant_force"

    @staticmethod
    def function(t, q, v, params):
        return (params["force"],)


class HarmonicDrive(Effect):
    """A harmonic force ``F = f cos(w t + phi)`` on bodies.

    Args:
        bodies: a name, or a list of names.
        amplitude: f, N, (d,); or one for each body, (n, d).
        frequency: w, rad/s, positive; one number, or one for each.
        phase: phi, rad; likewise.
    """

    bodies: Any = names()
    amplitude: Any = vector()
    frequency: Any = positive()
    phase: Any = number(default=0.0)

    kind = "force"
    default_name = "harmonic_drive"

    @staticmethod
    def function(t, q, v, params):
        return (params["amplitude"] * jnp.cos(params["frequency"] * t + params["phase"])[..., None],)


class Drive(Effect):
    """A force ``F = f(t)`` on bodies, any function of time.

    Args:
        bodies: a name, or a list of names; each gets this force.
        history: ``history(t, params) -> (d,)``, N.
        params: of `history`, numbers by name. They may change without a new compilation, and runs have derivatives with
            respect to them.
    """

    bodies: Any = names()
    history: Callable = of_time()
    params: Any = field(default_factory=dict)

    kind = "force"

    @staticmethod
    def function(history, t, q, v, params):
        return (history(t, params),)

    def _parameters(self):
        params = self.params_of_time
        if not isinstance(params, dict):
            raise Refused(f"{self.name}: params is {self.params!r}; give numbers by name, such as {{'size': 2.0}}.")
        return params | self.points


class FollowerForce(BetweenPoints):
    """A force on b that turns with the line from a to b: ``F = f (q_b - q_a) / |q_b - q_a|``, a jet at the end of a
    rod.

    Args:
        between: names (a, b), or a list of such pairs.
        force: f, N; positive pushes b away from a; one number, or one for each.
    """

    force: Any = number()

    kind = "force"
    default_name = "follower_force"

    @staticmethod
    def function(t, q, v, params):
        a, b = q
        direction = (b - a) / jnp.linalg.norm(b - a, axis=-1, keepdims=True)
        return jnp.zeros_like(a), params["force"][..., None] * direction


def norm(v):
    """``|v|``, with derivative zero at v = 0."""
    square = jnp.sum(v**2, axis=-1)
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)


class _AgainstMotion(Effect):
    """Base class of forces ``-c ... v`` against the motion of each body."""

    coefficient: Any = positive()
    bodies: Any = names(default=None)

    kind = "force"


class LinearDamping(_AgainstMotion):
    """Damping of points and of the centres of rigid bodies against the ground, ``F = -c v``; rotations are not damped.

    Args:
        coefficient: c, N s/m, positive; one number, or one for each body.
        bodies: names; all bodies of the scene by default.
    """

    default_name = "damping"

    @staticmethod
    def function(t, q, v, params):
        (v,) = v
        return (-params["coefficient"][..., None] * v,)


class QuadraticDrag(_AgainstMotion):
    """Drag of a resting fluid, ``F = -c |v| v``.

    Args:
        coefficient: c, kg/m, positive: density times drag coefficient times area, over 2; one number, or one for each
            body.
        bodies: names; all bodies of the scene by default.
    """

    default_name = "drag"

    @staticmethod
    def function(t, q, v, params):
        (v,) = v
        return (-(params["coefficient"] * norm(v))[..., None] * v,)


class Dashpot(BetweenPoints):
    """Dampers between points, against the change of their distance: ``F_b = -c ((v_b - v_a) . n) n = -F_a``, n from a
    to b.

    Args:
        between: names of two bodies, or a list of such pairs.
        coefficient: c, N s/m, positive; one number, or one for each.
    """

    coefficient: Any = positive()

    kind = "force"
    default_name = "dashpots"

    @staticmethod
    def function(t, q, v, params):
        (a, b), (v_a, v_b) = q, v
        along = b - a
        rate = jnp.sum((v_b - v_a) * along, axis=-1) / jnp.sum(along**2, axis=-1)
        force = -(params["coefficient"] * rate)[..., None] * along
        return -force, force


class RayleighDamping(Effect):
    """Rayleigh damping of the whole scene, ``F = -(alpha M + beta K(q)) v``, K the Hessian of potentials by the
    positions of points, and by the angles and displacements of joints, that they are functions of.

    M has the masses of points and of the centres of rigid bodies: alpha does not damp rotations.

    The damping ratio of a vibration of frequency w is ``alpha / (2 w) + beta w / 2``. K is the Hessian at the present
    configuration; along directions of negative curvature the force adds energy.

    Args:
        mass: alpha, 1/s, positive; None for zero.
        stiffness: beta, s, positive; None for zero if there is a mass.
        of: names of the potentials in K; all potentials of the scene by default.
    """

    mass: Any = array(default=None, sign="positive")
    stiffness: Any = array(default=None, sign="positive")
    of: Any = None

    kind = "force"
    default_name = "rayleigh_damping"

    @staticmethod
    def function(t, q, v, params):
        (v,) = v
        return (-(params["mass"] * params["mass_of"])[..., None] * v,)

    @property
    def masses(self):
        return () if self.mass is None else ("mass_of",)

    def resolved(self, effects):
        """The effect with its potentials in a tuple instead of their names."""
        potentials = {effect.name: effect for effect in effects if effect.kind == "potential"}
        names = potentials if self.of is None else [self.of] if isinstance(self.of, str) else self.of
        for name in names:
            if name not in potentials:
                raise Refused(f"{self.name}: {unknown('potential', name, potentials)}")
        # a potential in a joint has the joint itself, too, before its terms are asked for
        return replace(self, of=tuple(potentials[name].resolved(effects).bound(self.by_name) for name in names))

    def _elements(self):
        return tuple((name,) for name in self.by_name)

    def check_parameters(self):
        if self.mass is None and self.stiffness is None:
            raise Refused(f"{self.name}: mass and stiffness are both None; give at least one of them.")
        super().check_parameters()

    def terms(self, select, layout):
        terms = () if self.mass is None else super().terms(select, layout)
        damped = [
            replace(term, function=Applied(stiffness_times, (term.function,)), arguments=ARGUMENTS["kinetic"])
            for potential in self.of
            for term in potential.terms(range(len(potential.elements)), layout)
        ]
        return terms if self.stiffness is None or not damped else (*terms, TangentDamping(joined(damped), self.name))
