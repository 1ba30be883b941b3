"""What a comparison has done so far, in one SQLite file: a run that was interrupted goes on where it stopped."""

from __future__ import annotations

import hashlib
import io
import json
import os
import sqlite3
import sys
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

_PLAIN = (bool, int, float, complex, str, bytes, np.generic, torch.dtype, torch.device)

Rows = tuple[dict[str, Any], ...]

_APPLICATION = 0x6C617464  # "latd": tells our files from other SQLite files
_SCHEMA = """CREATE TABLE IF NOT EXISTS cells (
    key TEXT PRIMARY KEY, method TEXT NOT NULL, demonstration TEXT NOT NULL, seed INTEGER NOT NULL,
    rows TEXT NOT NULL, paths BLOB NOT NULL
) WITHOUT ROWID"""


class CellStore:
    """Finished cells in a SQLite file, one transaction each. One process writes; use as a context manager.

    Args:
        path: of the file; made if absent. On a local disk: SQLite's write-ahead log needs shared memory.

    Raises:
        ValueError: if the file holds something else.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        try:
            self._connection = sqlite3.connect(self.path, timeout=60, isolation_level=None)
            self._open()
        except sqlite3.DatabaseError as error:
            raise ValueError(f"store: expected a file of finished cells, got {self.path} ({error})") from None

    def _open(self) -> None:
        ours = self._connection.execute("PRAGMA application_id").fetchone()[0] == _APPLICATION
        if not ours and self._connection.execute("SELECT 1 FROM sqlite_master").fetchone():
            raise sqlite3.DatabaseError("a database of another kind")
        self._connection.execute("PRAGMA journal_mode = WAL")
        self._connection.execute(f"PRAGMA application_id = {_APPLICATION}")
        self._connection.execute(_SCHEMA)

    def __enter__(self) -> CellStore:
        return self

    def __exit__(self, *_: object) -> None:
        self._connection.close()

    def __len__(self) -> int:
        return int(self._connection.execute("SELECT count(*) FROM cells").fetchone()[0])

    def keys(self) -> set[str]:
        return {key for (key,) in self._connection.execute("SELECT key FROM cells")}

    def get(self, key: str) -> tuple[Rows, NDArray[np.float64]] | None:
        """The rows and rollouts of a cell, or None if it was not finished."""
        found = self._connection.execute("SELECT rows, paths FROM cells WHERE key = ?", (key,)).fetchone()
        if found is None:
            return None
        return tuple(json.loads(found[0])), np.load(io.BytesIO(found[1]), allow_pickle=False)

    def put(self, key: str, rows: Rows, paths: NDArray[np.float64]) -> None:
        """Keep a finished cell; the first to come stays."""
        packed = io.BytesIO()
        np.save(packed, paths, allow_pickle=False)
        named = (rows[0]["method"], rows[0]["demonstration"], rows[0]["seed"])
        self._connection.execute(
            "INSERT OR IGNORE INTO cells VALUES (?, ?, ?, ?, ?, ?)", (key, *named, json.dumps(rows), packed.getvalue())
        )


def fingerprint(*things: Any) -> str:
    """A hash of values, tensors and objects all the way down, and of the code that they and this library consist of.

    Equal in every process for equal settings: nothing in it depends on addresses, hash seeds or order of sets.
    """
    digest, sources = hashlib.sha256(), set(_library())
    for part in _parts(things, sources.add, ()):
        digest.update(part)
    for source in sorted(map(_content, sources)):
        digest.update(source)
    return digest.hexdigest()


@cache
def _library() -> tuple[Path, ...]:
    drawing = {"plotting.py", "testing.py"}  # change no number
    return tuple(path for path in Path(__file__).parent.glob("*.py") if path.name not in drawing)


@cache
def _content(path: Path) -> bytes:
    return hashlib.sha256(path.read_bytes()).digest()


def _parts(thing: Any, source: Callable[[Path], None], above: tuple[int, ...]) -> Iterator[bytes]:
    yield f"<{type(thing).__module__}.{type(thing).__qualname__}>".encode()
    if thing is None or isinstance(thing, _PLAIN):
        yield repr(thing).encode()
    elif isinstance(thing, (Tensor, np.ndarray)):
        array = thing.detach().cpu().numpy() if isinstance(thing, Tensor) else thing
        yield f"{array.dtype}{array.shape}".encode()
        yield np.ascontiguousarray(array).tobytes()
    elif id(thing) in above:
        yield f"^{len(above) - above.index(id(thing))}".encode()
    else:
        for child in _children(thing, source):
            yield from _parts(child, source, (*above, id(thing)))
    yield b"</>"


def _children(thing: Any, source: Callable[[Path], None]) -> list[Any]:
    if isinstance(thing, Mapping):
        return [item for pair in thing.items() for item in pair]
    if isinstance(thing, (list, tuple)):
        return list(thing)
    if isinstance(thing, (set, frozenset)):
        return sorted(fingerprint(item) for item in thing)
    if isinstance(thing, type):
        _cite(thing, source)
        return [thing.__qualname__]
    if isinstance(thing, FunctionType):
        code = thing.__code__
        return [thing.__qualname__, code.co_code, [c for c in code.co_consts if not isinstance(c, CodeType)]]
    if isinstance(thing, ModuleType):
        return [thing.__name__]
    for base in type(thing).__mro__:
        _cite(base, source)
    try:
        reduced = thing.__reduce_ex__(2)  # what a pickle of it would hold
    except Exception:
        return [vars(thing)] if hasattr(thing, "__dict__") else []
    return [reduced] if isinstance(reduced, str) else [list(p) if isinstance(p, Iterator) else p for p in reduced]


def _cite(kind: type, source: Callable[[Path], None]) -> None:
    file = getattr(sys.modules.get(kind.__module__), "__file__", None)
    if file and Path(file).suffix == ".py":
        source(Path(file))
