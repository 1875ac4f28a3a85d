"""Files that pages include: they exist, and have the line that each page starts at."""

import re
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[2] / "docs"
INCLUDE = re.compile(r"literalinclude:: (?P<file>\S+)(?P<options>(?:\n +:\S+:[^\n]*)*)")
INCLUDES = [
    (page, match)
    for page in sorted(DOCS.rglob("*.rst"))
    for match in INCLUDE.finditer(page.read_text(encoding="utf-8"))
]


@pytest.mark.parametrize(("page", "match"), INCLUDES, ids=[page.stem for page, _ in INCLUDES])
def test_included_files_have_the_line_where_the_page_starts(page, match):
    text = (page.parent / match["file"]).read_text(encoding="utf-8")
    for start in re.findall(r":start-at: (.*)", match["options"]):
        assert start in text
