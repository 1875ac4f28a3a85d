"""How a macro step of a system under a scheme is taken: decided once, from structure alone."""

from dataclasses import dataclass

from vmri_jax.mechanics.state import State
from vmri_jax.mechanics.system import System
from vmri_jax.schemes.composition import Composition, stage_scheme
from vmri_jax.schemes.scheme import Scheme
from vmri_jax.steppers.newton import Newton
from vmri_jax.steppers.split import drifts
from vmri_jax.steppers.step import StepInfo, advance, projected, start_memory


@dataclass(frozen=True)
class Stepper:
    """Takes macro steps: ``own = init(state, dt)``, then ``state, info, own = step(state, own, dt)`` again and again.

    Attributes:
        projects_rarely: whether momenta need the projection only where they are looked at; else `project` follows every step.
    """

    system: System
    scheme: Scheme | Composition
    newton: Newton
    projects_rarely: bool

    def init(self, state: State, macro_dt):
        """What the first step starts from besides the state."""
        return start_memory(self.system, self.scheme, state, macro_dt, self.newton)

    def step(self, state: State, own, macro_dt) -> tuple[State, StepInfo, object]:
        """One macro step, momenta not projected."""
        return advance(self.system, self.scheme, state, macro_dt, self.newton, own, project=False)

    def project(self, state: State, own) -> tuple[State, object]:
        """Momenta onto the hidden constraints."""
        return projected(self.system, state, own)


def plan(system: System, scheme: Scheme | Composition, newton: Newton, state: State) -> Stepper:
    """The stepper for states of this shape."""
    stage = stage_scheme(scheme)
    held = system.is_constrained and newton.marches(system, stage)
    rarely = held and drifts(system, stage, state.q_s, state.q_f)
    return Stepper(system, scheme, newton, rarely)
