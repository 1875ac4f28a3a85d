"""Systems that are hard to integrate: linkages, chains, contact, a close encounter, three time scales."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np

import vmri_jax as vm
from vmri_jax.systems.fermi_pasta_ulam import fermi_pasta_ulam, soft_springs


def arrays(**numbers) -> dict:
    """Numbers as parameters of a system."""
    return {name: jnp.asarray(value) for name, value in numbers.items()}


def lengths_of(points):
    """Distances between consecutive points (k, d), shape (k - 1,)."""
    return jnp.sqrt(jnp.sum((points[1:] - points[:-1]) ** 2, axis=1))


def links_of(points, length):
    """``(|x_{i+1} - x_i|^2 - l^2) / 2`` between consecutive points, shape (k - 1,)."""
    return (jnp.sum((points[1:] - points[:-1]) ** 2, axis=1) - length**2) / 2


# --- a constraint that hardly depends on the fast variables ----------------------------------------------------------
def tether(q_s, q_f, params):
    """``V = kappa/2 |q_1 - q_2|^2``."""
    return params["kappa"] / 2 * jnp.sum((q_s - q_f) ** 2)


def stiff_cage(q_f, params):
    """``W = omega^2/2 |q_2 - a|^2``."""
    return params["omega"] ** 2 / 2 * jnp.sum((q_f - params["anchor"]) ** 2)


def nearly_slow(q_s, q_f, params):
    """``g = (|q_1|^2 + eps z_2^2 - l^2) / 2``."""
    return jnp.stack([(jnp.sum(q_s**2) + params["eps"] * q_f[2] ** 2 - params["square"]) / 2])


def nearly_slow_constraint(eps: float) -> vm.Problem:
    """A slow and a fast point in R^3 with ``|q_1|^2 + eps z_2^2 = l^2``: the fast Jacobian vanishes with eps."""
    q_s, q_f = jnp.array([1.0, 0.0, 0.0]), jnp.array([0.0, 0.0, 1.0])
    params = arrays(kappa=1.0, omega=50.0, anchor=q_f, eps=eps, square=1.0 + eps)
    system = vm.System(vm.ConstantMass([10.0] * 3, [1.0] * 3), tether, stiff_cage, nearly_slow, params=params)
    return vm.Problem(system, q_s, q_f, jnp.array([0.0, 0.3, 0.0]), jnp.array([0.2, 0.0, 0.0]), project=True)


# --- linkages and chains ---------------------------------------------------------------------------------------------
def pull_on_crank(q_s, q_f, params):
    """``V = kappa/2 (x_s - x_1)^2``: a slide, held by a spring to the crank."""
    return params["kappa"] / 2 * jnp.sum((q_s[0] - q_f[0]) ** 2)


def four_bars(q_s, q_f, params):
    """Crank, coupler and rocker: ``(|x_1|^2 - a^2)/2``, ``(|x_2 - x_1|^2 - d^2)/2``, ``(|x_2 - (d, 0)|^2 - a^2)/2``."""
    x_1, x_2, base = q_f[:2], q_f[2:], jnp.stack([params["base"], jnp.zeros(())])
    square = jnp.stack([jnp.sum(x_1**2), jnp.sum((x_2 - x_1) ** 2), jnp.sum((x_2 - base) ** 2)])
    return (square - jnp.stack([params["crank"], params["base"], params["crank"]]) ** 2) / 2


def four_bar(angle: float, kappa: float = 0.0) -> vm.Problem:
    """Parallelogram linkage (fast), with a heavy slide (slow) on a spring; singular at angle 0.

    Args:
        angle: of the crank at the start; it turns with speed 1.
        kappa: stiffness of the spring; without it the linkage turns uniformly.
    """
    base = 2.0
    system = vm.System(
        vm.ConstantMass([50.0], [1.0] * 4),
        slow_potential=pull_on_crank,
        constraint=four_bars,
        params=arrays(crank=1.0, base=base, kappa=kappa),
    )
    tip = np.array([np.cos(angle), np.sin(angle)])
    velocity = np.array([-np.sin(angle), np.cos(angle)])
    q_f, v_f = np.concatenate([tip, [tip[0] + base, tip[1]]]), np.tile(velocity, 2)
    return vm.Problem(system, jnp.array([-1.0]), jnp.asarray(q_f), jnp.array([0.0]), jnp.asarray(v_f), project=True)


def chain_weight(q_s, q_f, params):
    """``V = g sum_i m y_i``."""
    return params["gravity"] * params["mass"] * jnp.sum(q_f[1::2])


def rigid_links(q_s, q_f, params):
    """Rigid links from the trolley (x, 0) on, ``(|x_{i+1} - x_i|^2 - l^2) / 2``."""
    points = jnp.concatenate([q_s, jnp.zeros(1), q_f]).reshape(-1, 2)
    return links_of(points, params["length"])


def link_chain(num_links: int = 20, bend: float = 0.0) -> vm.Problem:
    """Chain of rigid links in the plane (fast), from a rolling trolley (slow); started to the side.

    Args:
        num_links: points of mass 0.1 on links of length 0.1.
        bend: angle of the links up and down from the horizontal, in turns; 0 is straight.
    """
    length, mass = 0.1, 0.1
    params = arrays(length=length, mass=mass, gravity=9.81)
    signs = np.where(np.arange(num_links) % 2, -1.0, 1.0)
    steps = length * np.stack([np.full(num_links, np.cos(bend)), signs * np.sin(bend)], axis=1)
    masses = vm.ConstantMass([10.0], np.full(2 * num_links, mass))
    system = vm.System(masses, chain_weight, constraint=rigid_links, params=params)
    q_f = jnp.asarray(np.cumsum(steps, axis=0).reshape(-1))
    return vm.Problem(system, jnp.zeros(1), q_f, jnp.array([0.1]), jnp.zeros(2 * num_links), project=True)


def hung_weight(q_s, q_f, params):
    """Gravity on chain and load, and the soft spring between them, ``kappa/2 (|x_s - x_n| - l)^2``."""
    weight = params["gravity"] * (params["load"] * q_s[1] + params["mass"] * jnp.sum(q_f[1::2]))
    stretch = lengths_of(jnp.stack([q_f[-2:], q_s]))[0] - params["soft_length"]
    return weight + params["kappa"] / 2 * stretch**2


def stiff_links(q_f, params):
    """``W = k/2 sum_i (|x_{i+1} - x_i| - l)^2`` from the origin on."""
    stretch = lengths_of(jnp.concatenate([jnp.zeros(2), q_f]).reshape(-1, 2)) - params["length"]
    return params["stiffness"] / 2 * jnp.sum(stretch**2)


def stiff_chain(num_masses: int = 50) -> vm.Problem:
    """Near-inextensible chain of unit masses (fast) with a load on a soft spring (slow), let go sideways."""
    length, angle = 0.2, 0.3
    params = arrays(length=length, mass=1.0, stiffness=1e6, gravity=9.81, load=100.0, kappa=500.0, soft_length=1.0)
    down = np.array([np.sin(angle), -np.cos(angle)])
    points = length * np.arange(1, num_masses + 1)[:, None] * down
    system = vm.System(vm.ConstantMass([100.0] * 2, np.ones(2 * num_masses)), hung_weight, stiff_links, params=params)
    q_s = jnp.asarray(points[-1] + 1.0 * down)
    return vm.Problem(system, q_s, jnp.asarray(points.reshape(-1)), jnp.zeros(2), jnp.zeros(2 * num_masses))


# --- contact, a close encounter --------------------------------------------------------------------------------------
def ball_weight(q_s, q_f, params):
    """``V = m g z``."""
    return params["gravity"] * q_f[0]


def floor_contact(q_f, params):
    """``W = k/2 min(z, 0)^2``: a stiff floor that only pushes."""
    return params["stiffness"] / 2 * jnp.minimum(q_f[0], 0.0) ** 2


def bouncing_ball() -> vm.Problem:
    """A ball of unit mass dropped on a stiff floor: x slow, height z fast."""
    masses, params = vm.ConstantMass([1.0], [1.0]), arrays(stiffness=1e8, gravity=9.81)
    system = vm.System(masses, ball_weight, floor_contact, params=params)
    return vm.Problem(system, jnp.zeros(1), jnp.ones(1), jnp.ones(1), jnp.zeros(1))


def trap(q_s, q_f, params):
    """``V = kappa/2 |c|^2`` on the centre of mass."""
    return params["kappa"] / 2 * jnp.sum(q_s**2)


def gravitation(q_f, params):
    """``W = -mu / |r|``."""
    return -params["mu"] / jnp.sqrt(jnp.sum(q_f**2))


def two_body(eccentricity: float = 0.9) -> vm.Problem:
    """Centre of mass of two bodies in a soft trap (slow), relative position (fast) from the apocentre; period 2 pi."""
    masses, params = vm.ConstantMass([4.0] * 2, [1.0] * 2), arrays(kappa=0.01, mu=1.0)
    system = vm.System(masses, trap, gravitation, params=params)
    speed = np.sqrt((1 - eccentricity) / (1 + eccentricity))
    q_f, v_f = jnp.array([1.0 + eccentricity, 0.0]), jnp.array([0.0, speed])
    return vm.Problem(system, jnp.array([1.0, 0.0]), q_f, jnp.zeros(2), v_f, project=True)


# --- variants of the Fermi-Pasta-Ulam chain --------------------------------------------------------------------------
def three_stiff_springs(q_f, params):
    """``W = sum_i omega_i^2 / 2 f_i^2``."""
    return jnp.sum(params["omega"] ** 2 * q_f**2) / 2


def three_scales(omega=(50.0, 70.0, 5000.0)) -> vm.Problem:
    """FPU chain with a frequency of its own for every stiff spring; all but the first at rest."""
    problem = fermi_pasta_ulam(len(omega), omega[0])
    system = problem.system.replace(fast_potential=three_stiff_springs, params=arrays(omega=omega))
    second = jnp.zeros(len(omega)).at[1].set(1.0)
    return replace(problem, system=system, q_f=problem.q_f + second / omega[1], v_f=problem.v_f + second)


def soft_and_cubic_springs(q_s, q_f, params):
    """The soft quartic springs, and a cubic coupling ``beta/3 sum_i (s_i - f_i)^3``."""
    return soft_springs(q_s, q_f, params) + params["beta"] / 3 * jnp.sum((q_s - q_f) ** 3)


def cubic_chain() -> vm.Problem:
    """FPU chain with a cubic soft coupling, which excites the resonances of third order."""
    problem = fermi_pasta_ulam()
    params = problem.system.params | arrays(beta=1.0)
    return replace(problem, system=problem.system.replace(slow_potential=soft_and_cubic_springs, params=params))


def everything_slow(q_s, q_f, params):
    """Both potentials of the chain with elongations called slow and centres called fast."""
    return soft_springs(q_f, q_s, params) + params["omega"] ** 2 / 2 * jnp.sum(q_s**2)


def swapped_chain() -> vm.Problem:
    """FPU chain whose slow and fast variables have been exchanged by mistake."""
    problem = fermi_pasta_ulam()
    kinetic = problem.system.kinetic
    assert isinstance(kinetic, vm.ConstantMass)
    system = vm.System(vm.ConstantMass(kinetic.fast, kinetic.slow), everything_slow, params=problem.system.params)
    return vm.Problem(system, problem.q_f, problem.q_s, problem.v_f, problem.v_s, project=True)
