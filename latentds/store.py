"""What a comparison has done so far, in one SQLite file: a run that was interrupted goes on where it stopped."""

from __future__ import annotations

import copyreg
import dis
import functools
import hashlib
import io
import json
import os
import pickle
import sqlite3
import sys
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from types import CellType, CodeType, FunctionType, ModuleType
from typing import Any

import numpy as np
import torch
from numba.extending import is_jitted
from numpy.typing import NDArray
from torch import Tensor

_PLAIN = (bool, int, float, complex, str, bytes, np.generic, torch.dtype, torch.device)

Rows = tuple[dict[str, Any], ...]

_APPLICATION = 0x6C617464  # "latd": tells our files from other SQLite files
_SCHEMA = """CREATE TABLE IF NOT EXISTS cells (
    key TEXT PRIMARY KEY, method TEXT NOT NULL, demonstration TEXT NOT NULL, seed INTEGER NOT NULL,
    rows TEXT NOT NULL, paths BLOB NOT NULL, digest BLOB NOT NULL
) WITHOUT ROWID"""


class CellStore:
    """Finished cells in a SQLite file, one transaction each. One process writes; use as a context manager.

    Args:
        path: of the file; made if absent. On a local disk: SQLite's write-ahead log needs shared memory.

    Raises:
        ValueError: if the file holds something else, or is damaged; that may show only in what reads it.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        if self.path.exists() and not self.path.is_file():
            raise self._refusal("no regular file")
        try:
            self._connection = sqlite3.connect(self.path, timeout=60, isolation_level=None)
        except sqlite3.DatabaseError as error:
            raise self._refusal(error) from None
        # Asked again after its tables were seen: another process that makes the file sets the number first.
        if not self._is_ours() and self._execute("SELECT 1 FROM sqlite_master") and not self._is_ours():
            raise self._refusal("a database of another kind")
        self._execute("PRAGMA journal_mode = WAL")
        self._execute(f"PRAGMA application_id = {_APPLICATION}")
        self._execute(_SCHEMA)
        self._execute("SELECT key, method, demonstration, seed, rows, paths, digest FROM cells LIMIT 0")

    def _is_ours(self) -> bool:
        return bool(self._execute("PRAGMA application_id")[0][0] == _APPLICATION)

    def _execute(self, command: str, values: tuple[Any, ...] = ()) -> list[Any]:
        try:
            return self._connection.execute(command, values).fetchall()
        except sqlite3.DatabaseError as error:
            raise self._refusal(error) from None

    def _refusal(self, reason: object) -> ValueError:
        return ValueError(f"store: expected a file of finished cells, got {self.path} ({reason})")

    def __enter__(self) -> CellStore:
        return self

    def __exit__(self, *_: object) -> None:
        self._connection.close()

    def __len__(self) -> int:
        return int(self._execute("SELECT count(*) FROM cells")[0][0])

    def keys(self) -> set[str]:
        return {key for (key,) in self._execute("SELECT key FROM cells")}

    def get(self, key: str) -> tuple[Rows, NDArray[np.float64]] | None:
        """The rows and rollouts of a cell, or None if it was not finished."""
        found = self._execute("SELECT rows, paths, digest FROM cells WHERE key = ?", (key,))
        if not found:
            return None
        rows, paths, digest = found[0]
        if not isinstance(rows, str) or not isinstance(paths, bytes) or digest != _digest(key, rows, paths):
            raise self._refusal("a damaged cell")
        return tuple(json.loads(rows)), np.load(io.BytesIO(paths), allow_pickle=False)

    def put(self, key: str, rows: Rows, paths: NDArray[np.float64]) -> None:
        """Keep a finished cell; the first to come stays."""
        packed = io.BytesIO()
        np.save(packed, paths, allow_pickle=False)
        named, told = (rows[0]["method"], rows[0]["demonstration"], rows[0]["seed"]), json.dumps(rows)
        kept = (key, *named, told, packed.getvalue(), _digest(key, told, packed.getvalue()))
        self._execute("INSERT OR IGNORE INTO cells VALUES (?, ?, ?, ?, ?, ?, ?)", kept)


def _digest(key: str, rows: str, paths: bytes) -> bytes:
    return hashlib.sha256(f"{key}{rows}".encode() + paths).digest()


class UnreadableError(ValueError):
    """Something whose content or code cannot be told from another's, so that no key can stand for it."""


def fingerprint(*things: Any) -> str:
    """A hash of values, tensors and objects all the way down, and of the code that they and this library consist of.

    Equal in every process for equal settings: nothing in it depends on addresses, hash seeds or order of sets.

    A function counts with its bytecode, names, constants, defaults and closure, a class with its attributes and those
    of its bases. Beside them counts where they come from: all Python files of the top-level package, which hold what
    the code calls; of a lone module its file; and outside of packages (a script, a notebook, stdin) also the values,
    functions and classes of the globals that the code names.

    Raises:
        UnreadableError: for what hides its content, such as a lock, a generator, or a compiled function without a name.
    """
    reading = _Reading()
    try:
        reading.add(things, ())
    except RecursionError:
        raise UnreadableError("expected things that can be read to their end, got some nested too deeply") from None
    for source in sorted(reading.sources | {_package(str(Path(__file__).parent))}):
        reading.digest.update(source)
    return reading.digest.hexdigest()


_DRAWING = {"plotting.py", "testing"}
"""Files and folders of this library that change no number."""
_CODE = (
    "co_code", "co_consts", "co_names", "co_varnames", "co_freevars", "co_cellvars", "co_flags", "co_argcount",
    "co_posonlyargcount", "co_kwonlyargcount", "co_exceptiontable",
)  # fmt: skip


@cache
def _content(path: str) -> bytes:
    return hashlib.sha256(Path(path).read_bytes()).digest()


@cache
def _package(folder: str) -> bytes:
    """The Python files of a package and its subpackages."""
    digest, ours = hashlib.sha256(), Path(folder) == Path(__file__).parent
    for path in sorted(Path(folder).rglob("*.py")):
        if not (ours and path.relative_to(folder).parts[0] in _DRAWING):
            digest.update(str(path.relative_to(folder)).encode() + path.read_bytes())
    return digest.digest()


class _Reading:
    """One fingerprint in the making."""

    def __init__(self) -> None:
        self.digest = hashlib.sha256()
        self.sources: set[bytes] = set()
        self.seen: list[type | FunctionType] = []
        """Each is read once: they name each other."""

    def add(self, thing: Any, above: tuple[int, ...]) -> None:
        self.digest.update(f"<{type(thing).__module__}.{type(thing).__qualname__}>".encode())
        if thing is None or thing is ... or isinstance(thing, _PLAIN) or type(thing).__module__ == "typing":
            self.digest.update(repr(thing).encode())
        elif isinstance(thing, (Tensor, np.ndarray)):
            array = thing.detach().cpu().numpy() if isinstance(thing, Tensor) else thing
            self.digest.update(f"{array.dtype}{array.shape}".encode())
            if array.dtype.hasobject:
                self.add(array.tolist(), above)
            else:
                self.digest.update(np.ascontiguousarray(array).tobytes())
        elif id(thing) in above:
            self.digest.update(f"^{len(above) - above.index(id(thing))}".encode())
        else:
            for child in self._children(thing):
                self.add(child, (*above, id(thing)))
        self.digest.update(b"</>")

    def _children(self, thing: Any) -> list[Any]:
        if isinstance(thing, CodeType):
            return [_bytecode(thing)]
        if isinstance(thing, CellType):
            try:
                return [thing.cell_contents]
            except ValueError:  # still empty
                return []
        if isinstance(thing, ModuleType):
            self._cite(thing.__name__)
            return [thing.__name__]
        if isinstance(thing, (type, FunctionType)):
            if (place := next((i for i, known in enumerate(self.seen) if known is thing), None)) is not None:
                return [place]
            self.seen.append(thing)
            return self._class(thing) if isinstance(thing, type) else self._function(thing)
        if isinstance(thing, (staticmethod, classmethod)):
            return [thing.__func__]
        if isinstance(thing, property):
            return [thing.fget, thing.fset, thing.fdel]
        if isinstance(thing, functools.cached_property):
            return [thing.func]
        if isinstance(thing, functools._lru_cache_wrapper):
            return [thing.__wrapped__]
        if is_jitted(thing):
            return [thing.py_func, thing.targetoptions]
        known = [] if type(thing).__module__ == "builtins" else [type(thing)]
        if isinstance(thing, Mapping):
            return known + [item for pair in thing.items() for item in pair]
        if isinstance(thing, (list, tuple)):
            return known + list(thing)
        if isinstance(thing, (set, frozenset)):
            return known + sorted(fingerprint(item) for item in thing)
        return known + self._object(thing)

    def _class(self, kind: type) -> list[Any]:
        self._cite(kind.__module__)
        if kind.__module__.partition(".")[0] == "torch":
            return [kind.__module__, kind.__qualname__]  # torch.export patches nn.Module's own methods as it goes
        found: list[Any] = [kind.__qualname__, *kind.__bases__]
        for name, value in sorted(vars(kind).items()):
            about = name.startswith("__") and not callable(value) and not hasattr(type(value), "__get__")
            if not about and name != "_abc_impl":
                slot = getattr(value, "__objclass__", None) is kind  # compiled, and found by its name
                found += [name] if slot else [name, value]
        return found

    def _function(self, function: FunctionType) -> list[Any]:
        code, around = function.__code__, function.__globals__
        found = [function.__qualname__, code, function.__defaults__, function.__kwdefaults__, function.__closure__]
        if not self._cite(around.get("__name__")):  # not __module__, which a decorator copies
            found += [part for name in sorted(_globals(code) & set(around)) for part in (name, around[name])]
        return found

    def _object(self, thing: Any) -> list[Any]:
        reduce: Any = copyreg.dispatch_table.get(type(thing))
        try:
            reduced = reduce(thing) if reduce else thing.__reduce_ex__(2)  # what a pickle of it would hold
        except Exception:
            raise UnreadableError(f"expected what can be told from another of its kind, got {thing!r:.200}") from None
        if isinstance(reduced, tuple):
            return [list(part) if isinstance(part, Iterator) else part for part in reduced]
        module = pickle.whichmodule(thing, reduced)  # type: ignore[attr-defined]
        try:
            found = functools.reduce(getattr, reduced.split("."), sys.modules[module])
        except (KeyError, AttributeError):
            found = None
        if found is not thing:
            raise UnreadableError(f"expected code that can be read or found by its name, got {thing!r:.200}")
        self._cite(module)
        return [reduced]

    def _cite(self, name: str | None) -> bool:
        """Note the files that a module's code comes from; whether they hold what the code calls, too."""
        module = sys.modules.get(name or "")
        spec = getattr(module, "__spec__", None)
        root = sys.modules.get((getattr(spec, "parent", None) or "").partition(".")[0])
        folders, file = getattr(root, "__path__", ()), getattr(module, "__file__", None)
        if folders:
            self.sources.update(map(_package, folders))
        elif file and os.path.isfile(file):
            self.sources.add(_content(file))
        return bool(folders) or (name or "").partition(".")[0] in sys.stdlib_module_names


@cache
def _bytecode(code: CodeType) -> bytes:
    reading = _Reading()
    reading.add([getattr(code, name, None) for name in _CODE], ())
    return reading.digest.digest()


@cache
def _globals(code: CodeType) -> set[str]:
    """Names that a function, and those nested in it, look up in their module."""
    inner = [_globals(part) for part in code.co_consts if isinstance(part, CodeType)]
    named = {step.argval for step in dis.get_instructions(code) if step.opname in ("LOAD_GLOBAL", "LOAD_NAME")}
    return named.union(*inner)
