"""The example in the README runs as printed."""

import re
from pathlib import Path


def test_example_runs(capsys):
    text = (Path(__file__).parent.parent / "README.md").read_text()
    example = re.search(r"```python\n(.*?)```", text, re.DOTALL)
    assert example
    exec(compile(example[1], "README.md", "exec"), {})
    energy_error, constraint = map(float, capsys.readouterr().out.split())
    assert energy_error < 0.1  # 0.044 of 1020
    assert constraint < 1e-12  # 9e-15
