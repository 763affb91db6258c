def test_toy_objects_are_written_where_asked(command, tmp_path):
    settings = ["kind=objects", "scenes=3", "frames=3", "size=16", "seed=1", "workers=1"]
    finished = command("data", "toy", f"out={tmp_path / 'toy'}", *settings)
    assert finished.status == 0
    assert finished.out.splitlines()[-1] == str(tmp_path / "toy")
    assert len(list((tmp_path / "toy").glob("*/*/images/*.jpg"))) == 9
    assert (tmp_path / "toy" / "run.json").is_file()
