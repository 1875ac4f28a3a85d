"""``python -m vmri_jax.cli`` is ``vmri``."""

from vmri_jax.cli import main

main()
