"""Runs: one engine behind single runs, batches and streams to disk."""
