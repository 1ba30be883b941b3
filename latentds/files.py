"""Files: read once and within bounds, and written whole or not at all."""

from __future__ import annotations

import contextlib
import json
import os
import platform
import re
import secrets
import stat
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import IO

import safetensors.torch
from torch import Tensor

MAX_BYTES = 2**30
"""Largest file that is read, unpacked: a hostile one could name any size."""


def read_file(path: str | os.PathLike[str]) -> bytes:
    """All of a file, read once, so that nobody can replace it halfway.

    Raises:
        ValueError: if it is no regular file (a FIFO, a device, a folder) or holds more than ``MAX_BYTES``.
        FileNotFoundError: if there is no such file.
    """
    path = Path(path)
    try:
        # A FIFO would block until somebody writes to it.
        descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    except FileNotFoundError:
        raise FileNotFoundError(f"path: no such file: {path}") from None
    try:
        status = os.fstat(descriptor)
        _refuse_all_but_regular(path, status.st_mode)
        data, size = bytearray(), status.st_size
        while size <= MAX_BYTES and (chunk := os.read(descriptor, 2**20)):
            data += chunk
            size = max(size, len(data))
    finally:
        os.close(descriptor)
    if size > MAX_BYTES:
        raise ValueError(f"path: {path.name} holds {size} bytes, more than {MAX_BYTES}")
    return bytes(data)


def write_tensors(path: str | os.PathLike[str], tensors: Mapping[str, Tensor], about: str) -> None:
    """Write tensors and a text about them as one safetensors file. Atomic."""
    copies = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    with atomic_write(path) as file:
        file.write(safetensors.torch.save(copies, metadata={"latentds": about}))


def read_tensors(path: str | os.PathLike[str]) -> tuple[str, dict[str, Tensor]]:
    """The text and the tensors of a file that :func:`write_tensors` wrote.

    Raises:
        ValueError: if it is damaged, too large, or of another kind.
        FileNotFoundError: if there is no such file.
    """
    name, data = Path(path).name, read_file(path)
    try:
        tensors = safetensors.torch.load(data)
        header = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])
    except Exception as error:  # safetensors' own errors, and whatever a hostile header provokes
        raise ValueError(f"path: {name} is not a readable safetensors file ({error})") from None
    about = header.get("__metadata__", {}).get("latentds")
    if about is None:
        raise ValueError(f"path: expected a file that latentds wrote, got another safetensors file: {name}")
    return about, tensors


@contextmanager
def atomic_write(path: str | os.PathLike[str]) -> Iterator[IO[bytes]]:
    """Open a binary file that takes its place under ``path`` only when the block ends without an error.

    A symbolic link is followed, and a file that is there already hands on its permissions. A process that is killed
    meanwhile leaves a hidden file beside the target; the next writer removes it.

    Raises:
        ValueError: if there is something other than a regular file under ``path``.
    """
    target = Path(os.path.realpath(path))
    mode = target.stat().st_mode if target.exists() else None
    if mode is not None:
        _refuse_all_but_regular(target, mode)
    with contextlib.suppress(OSError):  # tidying up is no reason to fail
        _remove_leftovers(target)
    part = target.with_name(f".{target.name}.{os.getpid()}@{platform.node()}.{secrets.token_hex(8)}")
    try:
        # Not by tempfile, whose files nobody else may read even after they took their place.
        with open(part, "xb") as file:
            if mode is not None:
                os.chmod(part, stat.S_IMODE(mode))
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(part, target)
    except BaseException:
        part.unlink(missing_ok=True)
        raise


def _refuse_all_but_regular(path: Path, mode: int) -> None:
    if not stat.S_ISREG(mode):
        kind = "a folder" if stat.S_ISDIR(mode) else "a FIFO" if stat.S_ISFIFO(mode) else "a device or socket"
        raise ValueError(f"path: expected a regular file, got {kind}: {path}")


def _remove_leftovers(target: Path) -> None:
    """Remove the parts of ``target`` whose writers, processes of this machine, are no more."""
    name = re.compile(re.escape(f".{target.name}.") + r"(\d{1,9})@" + re.escape(platform.node()) + r"\.[0-9a-f]{16}")
    for file in os.listdir(target.parent):
        if (match := name.fullmatch(file)) and not _is_running(int(match[1])):
            target.with_name(file).unlink(missing_ok=True)


def _is_running(process: int) -> bool:
    if os.name != "posix":
        return True  # elsewhere signal 0 is no question
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass
    return True
