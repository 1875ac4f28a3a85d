"""The error of a run, and the steps that keep it."""
