"""Effects, each in a file of its own; `vmri_jax.scene` offers them all."""
