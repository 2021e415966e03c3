"""Files: whole or not at all, and none that is read is replaced."""

import errno
import os
import re
from pathlib import Path

import pytest

from dexsim.core import cli
from dexsim.core.files import write_atomic
from dexsim.errors import ConfigError


def test_a_pipe_is_written_into_and_a_link_stays_a_link(tmp_path):
    pipe, link, there = tmp_path / "pipe", tmp_path / "link.json", tmp_path / "elsewhere" / "there.json"
    os.mkfifo(pipe)
    there.parent.mkdir()
    there.write_text("old")
    link.symlink_to(there)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    try:
        for path in (pipe, link):
            cli.check_writable(path)
            cli.write_json(path, {"a": 1})
        assert os.read(reader, 100) == there.read_bytes()
    finally:
        os.close(reader)
    assert pipe.is_fifo() and link.is_symlink()
    assert {path.name for path in tmp_path.iterdir()} == {"pipe", "link.json", "elsewhere"}


def test_what_a_command_writes_replaces_nothing_that_it_reads_or_wrote(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    read, link, new = tmp_path / "read.toml", tmp_path / "link", tmp_path / "new.json"
    read.touch()
    link.symlink_to(read)
    for path in (Path("read.toml"), link):
        with pytest.raises(ConfigError, match=f"^--output {path}: is the calibration; name another file"):
            cli.check_no_overwrite({"--output": path}, {"policy": "grasp", "calibration": read})
    with pytest.raises(ConfigError, match="^--output new.json: is the file of --log, too"):
        cli.check_no_overwrite({"--log": new, "--output": Path("new.json")}, {})
    nowhere = Path(os.devnull)
    cli.check_no_overwrite({"--log": nowhere, "--output": nowhere, "--plot": None}, {"calibration": None})
    cli.check_no_overwrite({"--output": Path("grasp")}, {"policy": "grasp"})  # a name, and no file


def test_a_write_that_fails_leaves_the_file_before_it(tmp_path):
    def chunks():
        yield b"x" * 2**20
        raise OSError(errno.ENOSPC, "the disk is full")

    (tmp_path / "file").write_text("before")
    with pytest.raises(OSError, match=re.escape(f"the disk is full: '{tmp_path}/file'")):
        write_atomic(tmp_path / "file", chunks())
    assert [path.read_text() for path in tmp_path.iterdir()] == ["before"]
