"""The effects that `vmri_jax.scene` offers."""
