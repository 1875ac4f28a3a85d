"""Scheme and steps of a run that were chosen for an accuracy."""

from dataclasses import dataclass, field
from typing import Any

from vmri_jax.schemes.composition import Composition
from vmri_jax.schemes.plain_data import from_plain, to_plain
from vmri_jax.schemes.scheme import Scheme


@dataclass(frozen=True)
class Settings:
    """The arguments of `vmri_jax.simulate` that make the same run again, from the same start: ``vm.simulate(problem, **run.settings.arguments)``.

    Attributes:
        scheme: the scheme or composition.
        python: the expression that makes it.
        options: the same on the command line; empty for a scheme of one's own.
        macro_dt: H.
        num_steps, save_every: macro steps, and those from one saved node to the next.
        gain: time of single steps over that of these micro steps for the same error, by the prices and shares of the trial runs.
    """

    scheme: Scheme | Composition = field(compare=False)  # `python` and the numbers say all of it
    python: str
    options: str
    macro_dt: float
    num_steps: int
    save_every: int
    gain: float = 1.0

    @property
    def arguments(self) -> dict[str, Any]:
        """Arguments of `vmri_jax.simulate` by name."""
        steps = {"macro_dt": self.macro_dt, "num_steps": self.num_steps, "save_every": self.save_every}
        return {"scheme": self.scheme, **steps}

    def to_dict(self) -> dict[str, Any]:
        """As plain data, which JSON keeps."""
        return {**vars(self), "scheme": to_plain(self.scheme)}

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> "Settings":
        """The inverse of `to_dict`, also of what JSON makes of it.

        Args:
            data: from `to_dict`.
        """
        return cls(**{**data, "scheme": from_plain(data["scheme"])})

    def __str__(self) -> str:
        return f"{self.python}, macro_dt={self.macro_dt!r}, num_steps={self.num_steps}, save_every={self.save_every}"
