import errno
import os

import pytest

from torchqm.cli.console import UserError
from torchqm.cli.folder import staged_folder

NAMES = ("a.txt", "b.txt")


def write(out, text, error=None):
    """Write one file of a result, then fail."""
    with staged_folder(out, NAMES) as stage:
        (stage / "a.txt").write_text(text)
        if error is not None:
            raise error


def content(folder):
    return {p.name: p.read_text() for p in folder.iterdir()}


def test_folder_appears_whole_at_the_end_with_the_usual_permissions(tmp_path):
    out = tmp_path / "above" / "result"
    with staged_folder(out, NAMES) as stage:
        (stage / "a.txt").write_text("1")
        assert not out.exists()
    assert content(out) == {"a.txt": "1"}
    assert [p.name for p in out.parent.iterdir()] == ["result"]
    mask = os.umask(0)
    os.umask(mask)
    assert out.stat().st_mode & 0o777 == 0o777 & ~mask


def test_failure_leaves_nothing_not_even_the_folders_above(tmp_path):
    with pytest.raises(ZeroDivisionError):
        write(tmp_path / "x" / "y" / "z", "1", ZeroDivisionError())
    assert list(tmp_path.iterdir()) == []


def test_failure_leaves_an_earlier_result_as_it_was(tmp_path):
    (tmp_path / "a.txt").write_text("old")
    with pytest.raises(KeyboardInterrupt):
        write(tmp_path, "new", KeyboardInterrupt())
    assert content(tmp_path) == {"a.txt": "old"}


def test_success_replaces_an_earlier_result_and_keeps_other_files(tmp_path):
    for name in ("a.txt", "b.txt", "mine.txt"):
        (tmp_path / name).write_text("old")
    with staged_folder(tmp_path, NAMES) as stage:
        (stage / "a.txt").write_text("new")
    assert content(tmp_path) == {"a.txt": "new", "mine.txt": "old"}  # b.txt belonged to the earlier result


@pytest.mark.parametrize("below", ["", "sub", "sub/sub"])
def test_a_file_in_the_way_is_named_before_any_work(tmp_path, below):
    taken = tmp_path / "taken"
    taken.write_text("mine")
    with pytest.raises(UserError, match="taken") as error, staged_folder(taken / below, NAMES):
        pytest.fail("the block must not run")
    assert "file" in str(error.value)
    assert taken.read_text() == "mine"


def test_place_that_cannot_be_written_to(tmp_path, monkeypatch):
    def refuse(*_, **__):
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr("torchqm.cli.folder.tempfile.mkdtemp", refuse)  # root may write everywhere, so it is played
    with (
        pytest.raises(UserError, match=r"result: .*Permission denied"),
        staged_folder(tmp_path / "up" / "result", NAMES),
    ):
        pytest.fail("the block must not run")
    assert list(tmp_path.iterdir()) == []


def test_full_disk_is_said_in_one_line_and_leaves_nothing(tmp_path):
    with pytest.raises(UserError, match=r"result: cannot be written \(No space left on device\)"):
        write(tmp_path / "result", "half", OSError(errno.ENOSPC, "No space left on device"))
    assert list(tmp_path.iterdir()) == []
