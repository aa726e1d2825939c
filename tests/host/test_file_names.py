"""What is said of a file that does not exist."""

from truearm.file_names import no_such_file


def test_a_similar_name_is_proposed(tmp_path):
    (tmp_path / "panda_3.csv").touch()
    (tmp_path / "rig.toml").touch()
    assert no_such_file(tmp_path / "pnada_3.csv").endswith(f"no such file; did you mean {tmp_path / 'panda_3.csv'}?")
    assert no_such_file(tmp_path / "else.csv").endswith("else.csv: no such file; check its name and folder")


def test_a_missing_folder_is_named(tmp_path):
    text = no_such_file(tmp_path / "gone" / "rig.toml")
    assert text.endswith(f"because the folder {tmp_path / 'gone'} does not exist; check the path")


def test_a_link_to_nothing_is_not_its_own_proposal(tmp_path):
    (tmp_path / "rig.toml").symlink_to(tmp_path / "other")
    (tmp_path / "results").mkdir()
    assert "did you mean" not in no_such_file(tmp_path / "result.json")
    assert no_such_file(tmp_path / "result").endswith(f"did you mean {tmp_path / 'results'}?")
    assert "did you mean" not in no_such_file(tmp_path / "rig.toml")
