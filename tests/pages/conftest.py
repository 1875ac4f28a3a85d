"""A folder in which commands of pages run."""

import re

import pytest

from tests.pages.commands import CODES, FILES, ROOT, SMALLER, output


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Runs a command, unless it has been run, in a folder with the files that commands name: what it prints."""
    folder, printed = tmp_path_factory.mktemp("commands"), {}
    for name, page in FILES.items():
        text = (ROOT / page).read_text(encoding="utf-8")
        (folder / name).write_text(re.findall(r"```python\n(.*?)```", text, re.DOTALL)[0])

    def once(command: str) -> str:
        if command not in printed:
            code = next((code for start, code in CODES.items() if command.startswith(start)), 0)
            printed[command] = output(f"{command} {SMALLER.get(command, '')}", folder, code)
        return printed[command]

    return once
