"""A constraint that hardly sees the fast variables, linkages through singular configurations, a chain that hardly
stretches."""

import numpy as np

import vmri_jax as vm
from benchmarks.hard_cases import hard_case, iterations
from benchmarks.hard_cases.systems import four_bar, link_chain, nearly_slow_constraint, stiff_chain
from vmri_jax.hard_cases import Outcome
from vmri_jax.hard_cases.measures import constraints, energy, refusal, run, status


@hard_case("rank-deficient fast Jacobian")
def weak_fast_jacobian(full: bool) -> Outcome:
    """g = (|q_1|^2 + eps z_2^2 - l^2)/2, eps = 1 to 1e-8, and 0

    eps >= 1e-4 converges, 0 is recognised as slow-only
    """
    macro_dt, values, said = 1e-3, {}, {}
    for eps in (1.0, 1e-2, 1e-4, 1e-6, 1e-8):
        trajectory = run(nearly_slow_constraint(eps), vm.fully_implicit(5), macro_dt, 10_000 if full else 1_000)
        values[f"constraint_{eps:.0e}"] = constraints(trajectory)[0]
        values[f"iterations_{eps:.0e}"] = iterations(trajectory)
        said[eps] = status(trajectory)
    none = refusal(nearly_slow_constraint(0.0).state)
    recognised = "row(s) [0]" in none and "slow_constraint" in none
    last = min((eps for eps in said if np.isfinite(values[f"constraint_{eps:.0e}"])), default=np.inf)
    beyond = "; ".join(f"{eps:.0e}: {word}" for eps, word in said.items() if eps < last)
    return Outcome(
        f"H = {macro_dt:g}: converges down to eps = {last:.0e}{f' ({beyond})' if beyond else ''}; 0 is "
        f"{'recognised as slow-only' if recognised else 'not recognised'}",
        last <= 1e-4 and recognised and values["constraint_1e-04"] < 1e-12,
        values,
    )


@hard_case("singular configuration")
def singular_configuration(full: bool) -> Outcome:
    """four-bar linkage through its collinear position, straight 20-link chain

    no NaN, constraint below 1e-10, energy error at most 10 x that of a generic start, or round-off
    """
    scheme, steps = vm.fully_implicit(5), 2_000 if full else 200
    micro = 2 * np.arcsin(0.01 / 2)  # what the crank turns in a micro step of 0.01 without forces

    def runs(turning: float, sprung: float, bend: float) -> dict[str, vm.Trajectory]:
        return {
            "turning": run(four_bar(turning), scheme, 0.05, steps),
            "sprung": run(four_bar(sprung, kappa=20.0), scheme, 0.05, steps),
            "chain": run(link_chain(20, bend), scheme, 0.005, steps),
        }

    met = runs(-40 * micro, _meets_zero(scheme), 0.0)  # a micro node at the singularity, to round-off
    generic = runs(-1.0, -1.0, 0.25)
    band = {name: (energy(met[name], 1).band, energy(generic[name], 1).band) for name in met}
    worst = max(constraints(trajectory)[0] for trajectory in met.values())
    bounded = all(here < max(10 * there, 1e-10) for here, there in band.values())
    sizes = ", ".join(f"{name} {here:.1e} ({there:.1e})" for name, (here, there) in band.items())
    failed = "; ".join(f"{name}: {status(trajectory)}" for name, trajectory in met.items() if not trajectory.success)
    return Outcome(
        f"{failed + '; ' if failed else ''}constraint {worst:.0e}; energy error, in brackets generic: {sizes}",
        not failed and worst < 1e-10 and bounded,
        {"constraint": worst, **{f"energy_{name}": here for name, (here, _) in band.items()}},
    )


def _meets_zero(scheme, macro_steps: int = 8) -> float:
    """Start angle from which the sprung four-bar linkage is collinear after so many macro steps, by secants."""

    def height(angle):
        return float(run(four_bar(angle=angle, kappa=20.0), scheme, 0.05, macro_steps).q_f[-1, 1])

    a, b = -0.25, -0.2
    f, g = height(a), height(b)
    while abs(g) > 1e-13 and g != f:  # ends where it cannot get closer, or where the run fails
        a, b, f = b, b - g * (b - a) / (g - f), g
        g = height(b)
    return b


@hard_case("near-inextensible chain")
def stiff_springs_in_a_chain(full: bool) -> Outcome:
    """50 masses, k = 1e6, num_micro 20: fully_implicit, H = 0.02; fully_explicit, H = 0.001, 1e5 steps

    strain at most 3 x that of the load at rest and no growth in 1e5 steps, relative energy error below 1e-3
    """
    problem, steps = stiff_chain(), 2_000 if full else 50
    params = problem.system.params
    weight = params["gravity"] * (params["load"] + 50 * params["mass"])
    at_rest = float(weight / params["stiffness"] / params["length"])
    implicit = run(problem, vm.fully_implicit(20), 0.02, steps, save=steps // 50)
    explicit = run(problem, vm.fully_explicit(20), 0.001, 100_000, save=100)
    strain = {name: _strain(trajectory) / at_rest for name, trajectory in (("2", implicit), ("0.1", explicit))}
    half = len(strain["0.1"]) // 2
    growth = strain["0.1"][half:].max() / strain["0.1"][:half].max()
    band = max(energy(t, n, float(abs(t.energy[0]))).band for t, n in ((implicit, steps), (explicit, 100_000)))
    largest = ", ".join(f"{s.max():.2f} (omega h = {name})" for name, s in strain.items())
    return Outcome(
        f"{steps} implicit steps: {status(implicit)}, 1e5 explicit ones: {status(explicit)}; strain over that at rest "
        f"at most {largest}, in the second half {growth:.2f} x that of the first; relative energy error {band:.1e}",
        implicit.success
        and explicit.success
        and max(map(np.max, strain.values())) < 3
        and growth < 1.2
        and band < 1e-3,
        {"strain_implicit": strain["2"].max(), "strain_explicit": strain["0.1"].max(), "growth": growth, "band": band},
    )


def _strain(trajectory: vm.Trajectory) -> np.ndarray:
    """Largest strain of the links at every saved node."""
    points = np.asarray(trajectory.q_f).reshape(len(trajectory.t), -1, 2)
    points = np.concatenate([np.zeros_like(points[:, :1]), points], axis=1)
    return np.abs(np.linalg.norm(np.diff(points, axis=1), axis=2) / 0.2 - 1).max(axis=1)
