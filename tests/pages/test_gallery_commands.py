"""The two commands of every scene of the gallery run as printed: the run converges, and the picture is drawn.

Without --full, those of four scenes: points with micro steps, a scene without slow bodies, one body with forces, a
linkage of rigid bodies. The runs of all scenes are those of `tests/scene/test_gallery.py`, which also reads their
commands.
"""

import pytest

from tests.pages.commands import ROOT, blocks, output

PAGE = "notebooks/scenes/README.md"
OFTEN = ("valve_train", "bouncing_chain", "spinning_top", "four_bar")


def scene(block) -> str:
    """The name of the file of the scene."""
    return block.commands[0].split()[2].split("/")[-1].split(".")[0]


@pytest.mark.parametrize(
    "block", [pytest.param(b, marks=() if scene(b) in OFTEN else pytest.mark.full, id=scene(b)) for b in blocks(PAGE)]
)
def test_commands_run_as_printed(block, tmp_path):
    (tmp_path / "notebooks").symlink_to(ROOT / "notebooks")
    simulate, animate = block.commands
    assert "macro steps" in output(simulate, tmp_path)
    picture = simulate.split()[-1].replace(".npz", ".png")
    assert picture in output(animate, tmp_path)
    assert (tmp_path / picture).stat().st_size > 10_000
