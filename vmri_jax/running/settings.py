"""Scheme and steps of a run that were chosen for an accuracy."""

import shlex
from dataclasses import dataclass, field
from typing import Any

from vmri_jax.schemes.composition import SchemeLike, stage_scheme
from vmri_jax.schemes.plain_data import from_plain, to_plain


@dataclass(frozen=True)
class Settings:
    """The arguments of `vmri_jax.simulate` that repeat a run from the same start: ``vm.simulate(problem, **run.settings.arguments)``.

    Attributes:
        scheme: the scheme or composition.
        python: the Python expression of the scheme.
        options: the options of the scheme on the command line; empty for a scheme of the user.
        macro_dt: macro step H.
        num_steps: macro steps of the run.
        save_every: macro steps from one saved node to the next.
        gain: computing time with one micro step per macro step, divided by the time with the chosen number, for the same error; computed
            from the prices and error shares of the trial runs.
    """

    scheme: SchemeLike = field(compare=False)  # `python` and the numbers identify it
    python: str
    options: str
    macro_dt: float
    num_steps: int
    save_every: int
    gain: float = 1.0

    @property
    def arguments(self) -> dict[str, Any]:
        """Arguments of `vmri_jax.simulate` by name."""
        steps = {"macro_dt": self.macro_dt, "num_steps": self.num_steps, "save": self.save_every}
        return {"scheme": self.scheme, **steps}

    def command(self, system: str) -> str:
        """The command line that repeats the run of a system; without the scheme's options if the scheme is the user's."""
        steps = f"--macro-dt {self.macro_dt!r} --steps {self.num_steps} --save-every {self.save_every}"
        num_micro = stage_scheme(self.scheme).num_micro
        return f"vmri simulate {shlex.quote(system)} {self.options} --num-micro {num_micro} {steps}"

    def to_dict(self) -> dict[str, Any]:
        """Plain data for JSON."""
        return {**vars(self), "scheme": to_plain(self.scheme)}

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> "Settings":
        """The inverse of `to_dict`, also after a round trip through JSON."""
        return cls(**{**data, "scheme": from_plain(data["scheme"])})

    def __str__(self) -> str:
        return f"{self.python}, macro_dt={self.macro_dt!r}, num_steps={self.num_steps}, save={self.save_every}"
