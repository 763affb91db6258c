"""`completesplat report`: the paper's tables, with and without results of ours."""

import json

PROTOCOL = {"data_set": "toy_objects", "resolution": 64, "scenes": 2}


def test_without_runs_the_published_tables_are_written(command, tmp_path):
    finished = command.succeeds("report", f"out={tmp_path / 'out'}")
    for place in ("Table 2", "Table 3", "Table 4", "Table D1"):
        assert all(place in (tmp_path / f"out/tables.{kind}").read_text() for kind in ("md", "csv", "tex"))
    assert finished.out.splitlines()[-1] == str(tmp_path / "out")


def test_runs_are_listed_and_broken_files_are_named(command, tmp_path):
    for name in ("good", "bad"):
        (tmp_path / "runs" / name).mkdir(parents=True)
    scores = {"scenes": 2, "views": 4, "full": {"novel": {"psnr": 21.125}}}
    (tmp_path / "runs/good/metrics.json").write_text(json.dumps({"protocol": PROTOCOL, "model": scores}))
    (tmp_path / "runs/bad/metrics.json").write_text("{")
    finished = command.succeeds("report", f"runs={tmp_path / 'runs'}", f"out={tmp_path / 'out'}")
    assert "toy_objects, scores, 64 pixels" in finished.out
    assert "21.12" in finished.out
    assert str(tmp_path / "runs/bad/metrics.json") in finished.out + finished.err
