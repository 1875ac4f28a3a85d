"""Executors: where the tasks of ensembles, studies and maps are computed, in this process or by workers."""
