"""The example in the README runs as printed."""

import re
import subprocess
import sys
from pathlib import Path


def test_example_runs():
    """In a process of its own: settings are read when JAX starts."""
    text = (Path(__file__).parent.parent / "README.md").read_text()
    example = re.search(r"```python\n(.*?)```", text, re.DOTALL)
    assert example
    done = subprocess.run([sys.executable, "-c", example[1]], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    energy_error, constraint = map(float, done.stdout.split())
    assert energy_error < 0.1  # 0.044 of 1020
    assert constraint < 1e-12  # 9e-15
