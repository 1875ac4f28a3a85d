"""The schemes whose flow is verified."""

from vmri_jax import explicit_slow, fully_explicit, fully_implicit, galerkin

SCHEMES = {
    f"{kind} alpha {alpha}": make(5, alpha)
    for kind, make in (("explicit slow", explicit_slow), ("fully explicit", fully_explicit))
    for alpha in (0.0, 1.0, 0.5)
}
SCHEMES["fully implicit"] = fully_implicit(5)
SCHEMES |= {f"{rule} {degree}": galerkin(2, degree, rule) for rule in ("gauss", "lobatto") for degree in (1, 2, 3)}
