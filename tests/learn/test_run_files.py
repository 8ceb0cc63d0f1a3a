from torchqm.learn.run_files import set_aside, write_version


def test_what_is_there_is_kept_under_the_first_name_that_is_free(tmp_path):
    path = tmp_path / "a.yaml"
    for number in range(3):
        path.write_text(str(number))
        if number < 2:
            assert set_aside(path).name == f"a-{number + 1}.yaml"
    assert {file.name: file.read_text() for file in tmp_path.iterdir()} == {
        "a-1.yaml": "0",
        "a-2.yaml": "1",
        "a.yaml": "2",
    }


def test_equal_content_is_not_written_again(tmp_path):
    path = tmp_path / "new" / "a.json"
    write_version(path, "ä")
    when = path.stat().st_mtime_ns
    write_version(path, "ä")
    assert path.stat().st_mtime_ns == when
    write_version(path, "b")
    assert {file.name: file.read_text("utf-8") for file in path.parent.iterdir()} == {"a.json": "b", "a-1.json": "ä"}
