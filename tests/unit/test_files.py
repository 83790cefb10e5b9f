"""Files are written whole or not at all, and names that are not UTF-8 do no harm."""

from __future__ import annotations

import os
import stat

import pytest

from helmstar.files import readable, replacing, write_atomically


def test_a_file_is_replaced_at_the_end_only(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")
    with replacing(path) as part:
        part.write_text("new")
        assert path.read_text() == "old"
    assert path.read_text() == "new"
    assert os.listdir(tmp_path) == ["a.txt"]


def test_nothing_is_left_of_a_file_that_was_not_finished(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")

    def interrupted() -> None:
        with replacing(path) as part:
            part.write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == ["a.txt"]


def test_a_new_file_may_be_read_as_any_other(tmp_path):
    (tmp_path / "other").write_text("")
    path = write_atomically(tmp_path / "a.txt", "x")
    assert stat.S_IMODE(path.stat().st_mode) == stat.S_IMODE((tmp_path / "other").stat().st_mode)


def test_bytes_of_a_name_that_are_no_text_are_shown_as_such(tmp_path):
    name = os.fsdecode(b"caf\xc3\xa9 \xff\xfe.csv")
    assert readable(name) == "café \ufffd\ufffd.csv"
    assert write_atomically(tmp_path / "a.txt", name).read_text(encoding="utf-8") == readable(name)
