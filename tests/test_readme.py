"""The example in the README runs as printed."""

import re
import subprocess
import sys
from pathlib import Path


def test_example_runs(tmp_path):
    """In a process of its own, since settings are read when JAX starts; it prints what the page says."""
    text = (Path(__file__).parent.parent / "README.md").read_text()
    example = re.search(r"```python\n(.*?)```", text, re.DOTALL)
    assert example
    run = [sys.executable, "-c", example[1]]
    done = subprocess.run(run, capture_output=True, text=True, check=False, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert [f"`{line}`" in text for line in done.stdout.splitlines()] == [True, True], done.stdout
    assert (tmp_path / "run.png").stat().st_size > 10_000
