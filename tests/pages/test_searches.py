"""The searches that pages print, `vmri tune` and `vmri cost`, run as printed.

Each takes about 100 s of processor time, since it compiles some twenty schemes, and has died near its end before.
"""

import pytest

from tests.pages.commands import PAGES, SEARCHES, blocks, check

BLOCKS = [block for block in blocks(*PAGES) if block.commands[0].startswith(SEARCHES)]


@pytest.mark.parametrize("block", BLOCKS, ids=lambda block: f"{block.page}: {block.commands[0]}")
def test_searches_run_as_printed(block, run):
    check(block, run)
