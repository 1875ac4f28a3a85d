"""The two commands of every scene of the gallery run as printed: the run converges, and the picture is drawn."""

import pytest

from tests.pages.commands import ROOT, blocks, output

PAGE = "notebooks/scenes/README.md"
BLOCKS = blocks(PAGE)


@pytest.mark.parametrize("block", BLOCKS, ids=lambda block: block.commands[0].split()[2].split("/")[-1])
def test_commands_run_as_printed(block, tmp_path):
    """Above 20 s are scenes of rigid bodies, engine, four_bar, rigid_satellite and squeezer: programs of 60 to 100 coordinates."""
    (tmp_path / "notebooks").symlink_to(ROOT / "notebooks")
    simulate, animate = block.commands
    assert "macro steps" in output(simulate, tmp_path)
    picture = simulate.split()[-1].replace(".npz", ".png")
    assert picture in output(animate, tmp_path)
    assert (tmp_path / picture).stat().st_size > 10_000
