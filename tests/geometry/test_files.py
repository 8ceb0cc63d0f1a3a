import os
import stat

import pytest

from torchqm.geometry.files import write_whole


def test_writes_the_file_and_leaves_nothing_else(tmp_path):
    path = write_whole(tmp_path / "a.bin", lambda file: file.write(b"whole"))
    assert path.read_bytes() == b"whole"
    assert os.listdir(tmp_path) == ["a.bin"]


def test_a_failing_write_keeps_the_old_file_and_leaves_nothing_behind(tmp_path):
    path = tmp_path / "a.bin"
    path.write_bytes(b"old")

    def half(file):
        file.write(b"ha")
        raise RuntimeError("power cut")

    with pytest.raises(RuntimeError, match="power cut"):
        write_whole(path, half)
    assert path.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["a.bin"]


def test_others_may_read_what_was_written(tmp_path):
    path = write_whole(tmp_path / "a.bin", lambda file: file.write(b""))
    mask = os.umask(0o022)
    os.umask(mask)
    assert stat.S_IMODE(path.stat().st_mode) == 0o666 & ~mask
