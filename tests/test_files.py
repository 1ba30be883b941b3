"""Files are read once and within bounds, and written whole or not at all."""

from __future__ import annotations

import os
import platform
import stat
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch

from latentds.files import atomic_write, read_file, read_tensors, write_tensors

SPECIAL = {
    "FIFO": os.mkfifo,
    "folder": os.mkdir,
    "device or socket": lambda path: os.symlink("/dev/zero", path),
}


def write(path, text):
    with atomic_write(path) as file:
        file.write(text.encode())


@pytest.mark.parametrize("kind", SPECIAL)
def test_only_regular_files_are_read_and_written(tmp_path, kind):
    path = tmp_path / "a"
    SPECIAL[kind](path)
    with pytest.raises(ValueError, match=f"path: expected a regular file, got a {kind}: .*"):
        read_file(path)
    with pytest.raises(ValueError, match=f"path: expected a regular file, got a {kind}: .*"):
        write(path, "new")
    assert os.listdir(tmp_path) == ["a"]
    assert not stat.S_ISREG(path.stat().st_mode)


def test_reads_up_to_a_bound(tmp_path, monkeypatch):
    monkeypatch.setattr("latentds.files.MAX_BYTES", 10)
    (tmp_path / "a").write_bytes(b"0123456789")
    assert read_file(tmp_path / "a") == b"0123456789"
    (tmp_path / "a").write_bytes(b"0123456789+")
    with pytest.raises(ValueError, match="path: a holds 11 bytes, more than 10"):
        read_file(tmp_path / "a")
    # A file that grows, or does not know its size, is bounded by what comes out of it.
    monkeypatch.setattr("os.fstat", lambda _: os.stat_result((stat.S_IFREG, *[0] * 9)))
    with pytest.raises(ValueError, match="path: a holds 11 bytes, more than 10"):
        read_file(tmp_path / "a")


def test_missing_file(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"path: no such file: .*nothing"):
        read_file(tmp_path / "nothing")


def test_a_write_that_fails_leaves_the_old_file(tmp_path):
    path = tmp_path / "a"
    path.write_bytes(b"old")

    def write_half():
        with atomic_write(path) as file:
            file.write(b"new")
            raise RuntimeError("stop")

    with pytest.raises(RuntimeError, match="stop"):
        write_half()
    assert path.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["a"]


def test_a_new_file_has_the_usual_permissions_and_an_old_one_keeps_its_own(tmp_path):
    (tmp_path / "usual").write_bytes(b"")
    write(tmp_path / "a", "new")
    assert (tmp_path / "a").stat().st_mode == (tmp_path / "usual").stat().st_mode
    for mode in (0o600, 0o664, 0o755):
        (tmp_path / "a").chmod(mode)
        write(tmp_path / "a", "newer")
        assert stat.S_IMODE((tmp_path / "a").stat().st_mode) == mode


def test_a_link_is_followed(tmp_path):
    (tmp_path / "there").mkdir()
    for name in ("link", "link to link"):
        (tmp_path / name).symlink_to("there/target" if name == "link" else "link")
        for text in ("new", "newer"):  # at first the target is missing
            write(tmp_path / name, text)
            assert (tmp_path / "there" / "target").read_text() == text
        assert (tmp_path / name).is_symlink()
    assert os.listdir(tmp_path / "there") == ["target"]


KILLED = """
import os, signal, sys
from latentds.files import atomic_write
with atomic_write(sys.argv[1]) as file:
    file.write(b"half")
    file.flush()
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_leftovers_of_killed_writers_are_removed_and_no_others(tmp_path):
    path = tmp_path / "a.b"
    subprocess.run([sys.executable, "-c", KILLED, path])
    (left,) = os.listdir(tmp_path)
    assert left.startswith(".a.b.")
    token = "0" * 16
    others = {
        f".a.b.{os.getpid()}@{platform.node()}.{token}",  # somebody is still writing it
        left.replace(f"@{platform.node()}.", "@elsewhere."),  # who knows
        left.replace(".a.b.", ".a_b."),
        ".a.b.swp",
        "a.b.1",
    }
    for name in others:
        (tmp_path / name).write_text("theirs")
    write(path, "whole")
    assert set(os.listdir(tmp_path)) == {"a.b", *others}
    assert path.read_text() == "whole"


def test_writers_and_readers_at_once_see_whole_files(tmp_path):
    path = tmp_path / "a"

    def exchange(value):
        write_tensors(path, {"a": torch.full((1000,), value), "b": torch.full((10 * value + 1,), value)}, str(value))
        about, found = read_tensors(path)
        assert found["a"].unique().tolist() == found["b"].unique().tolist() == [int(about)]
        assert len(found["b"]) == 10 * int(about) + 1

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(exchange, range(200)))
    assert os.listdir(tmp_path) == ["a"]


@pytest.fixture
def leftovers(tmp_path):
    """Of two other processes of this machine."""
    paths = {process: tmp_path / f".a.{process}@{platform.node()}.{'0' * 16}" for process in (11, 12)}
    for path in paths.values():
        path.write_text("theirs")
    return paths


def test_what_another_user_is_writing_is_left_alone(tmp_path, monkeypatch, leftovers):
    """The system tells nobody to signal another's process; that it does tells that there is one."""

    def refuse(process, signal):
        raise PermissionError

    monkeypatch.setattr("os.kill", refuse)
    write(tmp_path / "a", "new")
    assert sorted(os.listdir(tmp_path)) == sorted(["a", *(path.name for path in leftovers.values())])


def test_two_that_tidy_up_at_once_do_not_stop_each_other(tmp_path, monkeypatch, leftovers):
    """Whichever comes first here, somebody else has just removed it."""
    asked = []

    def answer(process, signal):
        asked.append(process)
        if len(asked) == 1:
            leftovers[process].unlink()
        raise ProcessLookupError

    monkeypatch.setattr("os.kill", answer)
    write(tmp_path / "a", "new")
    assert sorted(asked) == [11, 12]
    assert os.listdir(tmp_path) == ["a"]
