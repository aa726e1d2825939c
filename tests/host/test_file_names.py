"""What is said of a file that does not exist."""

from truearm.file_names import missing_file


def test_a_similar_name_is_proposed(tmp_path):
    (tmp_path / "panda_3.csv").touch()
    (tmp_path / "rig.toml").touch()
    values = missing_file(tmp_path / "pnada_3.csv").values
    assert values == {"place": str(tmp_path / "pnada_3.csv"), "meant": str(tmp_path / "panda_3.csv")}
    assert missing_file(tmp_path / "else.csv").values["meant"] == ""


def test_a_missing_folder_is_named(tmp_path):
    assert missing_file(tmp_path / "gone" / "rig.toml").values["folder"] == str(tmp_path / "gone")


def test_a_link_to_nothing_is_not_its_own_proposal(tmp_path):
    (tmp_path / "rig.toml").symlink_to(tmp_path / "other")
    (tmp_path / "results").mkdir()
    assert missing_file(tmp_path / "result.json").values["meant"] == ""
    assert missing_file(tmp_path / "result").values["meant"] == str(tmp_path / "results")
    assert missing_file(tmp_path / "rig.toml").values["meant"] == ""
