"""The benchmark of scenes times a scene and the system written by hand."""

from benchmarks import scenes


def test_both_programs_are_timed(capsys):
    (report,) = scenes.run(scenes.Size(("FPU l=3",), ("fully explicit",), 2, 2, 1e-3, 10), "quick")
    assert [row["program"] for row in report.rows] == ["scene", "by hand"]
    assert report.claims[0].at_most == scenes.MOST
    report.show(scenes.COLUMNS)
    assert "FPU l=3 fully explicit scene" in " ".join(capsys.readouterr().out.split())
