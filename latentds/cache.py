"""The store of finished cells, one SQLite file: a run that was interrupted goes on where it stopped."""

from __future__ import annotations

import ast
import functools
import hashlib
import importlib.metadata
import importlib.util
import inspect
import io
import json
import os
import pickle
import platform
import sqlite3
import sys
from collections.abc import Iterable, Mapping
from contextlib import suppress
from functools import cache
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from types import CellType, CodeType, FunctionType, GetSetDescriptorType, MemberDescriptorType, ModuleType
from typing import Any, NamedTuple

import numpy as np
import torch
from numba.extending import is_jitted
from torch import Tensor

from .arguments import Array

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

    def get(self, key: str) -> tuple[Rows, Array] | None:
        """The rows and rollouts of a cell, or None if it was not finished."""
        cells = self._execute("SELECT rows, paths, digest FROM cells WHERE key = ?", (key,))
        if not cells:
            return None
        rows, paths, digest = cells[0]
        if not isinstance(rows, str) or not isinstance(paths, bytes) or digest != _digest(key, rows, paths):
            raise self._refusal("a damaged cell")
        return tuple(json.loads(rows)), np.load(io.BytesIO(paths), allow_pickle=False)

    def put(self, key: str, rows: Rows, paths: Array) -> None:
        """Keep a finished cell; the first to come stays."""
        packed = io.BytesIO()
        np.save(packed, paths, allow_pickle=False)
        name, text = (rows[0]["method"], rows[0]["demonstration"], rows[0]["seed"]), json.dumps(rows)
        cell = (key, *name, text, packed.getvalue(), _digest(key, text, packed.getvalue()))
        self._execute("INSERT OR IGNORE INTO cells VALUES (?, ?, ?, ?, ?, ?, ?)", cell)


def _digest(key: str, rows: str, paths: bytes) -> bytes:
    return hashlib.sha256(f"{key}{rows}".encode() + paths).digest()


class UnreadableError(ValueError):
    """Something whose content or code cannot be told from another's, so that no key can stand for it."""


def fingerprint(*things: Any) -> str:
    """A hash of values, tensors and objects all the way down, and of the code that they and a cell run.

    Equal in every process for equal settings: it does not depend on addresses, hash seeds or the order of sets.

    Objects count with what a pickle of them would hold, functions with their bytecode, defaults and closure, classes
    with their attributes and bases. The files that define these count, and what they import, directly or not, as far
    as it is in their own package, in this one, or not installed; other packages count with their version. A function
    from a script, a notebook or stdin counts with the globals that it names. What a counted file defines or imports
    and what is another thing in memory now counts, too: constants that were set, functions and methods that were
    replaced, and code that is older than its file, as after an edit.

    Not seen are data files, modules that are imported under a computed name, and globals that are neither a constant
    that is written out nor a function, class or import.

    Raises:
        UnreadableError: for what a pickle cannot hold, such as a lock, a generator, or a compiled function without a
            name.
    """
    pickler = _KeyPickler({f"{__package__}.cell"})
    try:
        pickler.dump(things)
        pickler.dump([platform.python_version(), *_sources(pickler.modules)])
    except Exception as error:
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise UnreadableError(f"expected settings and code that a pickle can hold, got {reason}") from None
    return hashlib.sha256(pickler.stream.getvalue()).hexdigest()


_NAMED = {"torch", "numpy", "scipy", "numba", *sys.stdlib_module_names}
"""Classes and functions of these count with their names alone, and the packages with their versions."""
_CODE = (
    "co_code", "co_consts", "co_names", "co_varnames", "co_freevars", "co_cellvars", "co_flags", "co_argcount",
    "co_posonlyargcount", "co_kwonlyargcount", "co_exceptiontable",
)  # fmt: skip
_PARTS: dict[type, Any] = {
    CodeType: lambda code: [getattr(code, name, None) for name in _CODE],
    CellType: lambda cell: cell.cell_contents,
    ModuleType: lambda module: module.__name__,
    GetSetDescriptorType: lambda slot: slot.__name__,
    MemberDescriptorType: lambda slot: slot.__name__,
    staticmethod: lambda method: method.__func__,
    classmethod: lambda method: method.__func__,
    property: lambda value: (value.fget, value.fset, value.fdel),
    functools.cached_property: lambda value: value.func,
    functools._lru_cache_wrapper: lambda function: function.__wrapped__,
    torch.dtype: str,
}
"""What stands for objects that are not pickled, or not by value."""


class _KeyPickler(pickle._Pickler):
    """A pickler for hashing: classes and functions go in by value, and equal things give equal bytes.

    Attributes:
        modules: those that define what was read.
    """

    def __init__(self, modules: set[str]) -> None:
        self.stream, self.modules = io.BytesIO(), modules
        super().__init__(self.stream, protocol=4)

    def memoize(self, obj: Any) -> None:
        # Whether two equal constants are one object is up to the compiler and the interpreter.
        if not isinstance(obj, (str, bytes, tuple, frozenset, CodeType, np.dtype)):
            super().memoize(obj)  # type: ignore[misc]

    def reducer_override(self, obj: Any) -> Any:
        kind, content = type(obj), None
        if isinstance(obj, type):
            content = self._class(obj)
        elif isinstance(obj, FunctionType):
            content = self._function(obj)
        elif isinstance(obj, (set, frozenset)):
            content = [kind, sorted(map(self._apart, obj)), getattr(obj, "__dict__", None)]
        elif isinstance(obj, Tensor):
            flat = obj.detach().cpu().to_dense().resolve_conj().resolve_neg().flatten()
            about = str(obj.dtype), str(obj.layout), tuple(obj.shape), obj.requires_grad
            content = [kind, about, flat.view(torch.uint8).numpy().tobytes()]
        elif kind is np.ndarray and not obj.dtype.hasobject:
            content = [obj.dtype, obj.shape, obj.tobytes()]
        elif kind in _PARTS:
            content = [_PARTS[kind](obj)]
            self.modules.update(content if kind is ModuleType else ())
        elif hasattr(obj, "py_func") and is_jitted(obj):
            content = [obj.py_func, obj.targetoptions]
        return NotImplemented if content is None else (object, (kind.__qualname__,), content)

    def _apart(self, item: Any) -> bytes:
        pickler = _KeyPickler(self.modules)
        pickler.dump(item)
        return pickler.stream.getvalue()

    def _class(self, kind: type) -> list[Any] | None:
        if kind is object:
            return None
        self.modules.add(kind.__module__)
        content: list[Any] = [kind.__module__, kind.__qualname__]
        if kind.__module__.partition(".")[0] in _NAMED:
            return content
        for name, value in sorted(vars(kind).items()):
            about = name.startswith("__") and not callable(value) and not hasattr(type(value), "__get__")
            if not about and name != "_abc_impl":
                content += [name, value]
        return [*content, kind.__bases__]

    def _function(self, function: FunctionType) -> list[Any]:
        code, around = function.__code__, function.__globals__
        home = str(around.get("__name__"))  # not __module__, which a decorator copies
        if home.partition(".")[0] in _NAMED and "<" not in function.__qualname__:
            return [home, function.__qualname__]
        self.modules.add(home)
        content = [function.__qualname__, code, function.__defaults__, function.__kwdefaults__, function.__closure__]
        if home == "__main__" or _spec(home) is None:
            content.append({name: around[name] for name in sorted(_names(code) & around.keys())})
        return content


def _names(code: CodeType) -> set[str]:
    """What a function, and those nested in it, may look up in their module."""
    return set(code.co_names).union(*map(_names, _inner(code)))


def _sources(names: Iterable[str]) -> list[Any]:
    """Modules and all that they import: names, contents of files, changed constants; and versions of packages."""
    own = {name.partition(".")[0] for name in names}
    modules: dict[str, Any] = {}
    versions: set[str] = set()
    todo = [name for name in names if name != "__main__"]
    while todo:
        name = todo.pop()
        spec, top = _spec(name), name.partition(".")[0]
        if name in modules or spec is None or not spec.origin or top in sys.stdlib_module_names:
            continue
        installed = not {"site-packages", "dist-packages"}.isdisjoint(Path(spec.origin).parts)
        if top in _NAMED or (installed and top not in own):
            versions.update(f"{name} {_version(name)}" for name in _distributions().get(top, ()))
            continue
        source = Path(spec.origin).read_bytes()
        if not spec.origin.endswith(".py"):
            modules[name] = (source, [])
            continue
        text = _read(source, spec.parent or "")
        modules[name] = (source, text.altered(getattr(sys.modules.get(name), "__dict__", {})))
        todo += [inner if _spec(inner := f"{base}.{part}") else base for base, part in text.imports]
    return [sorted(modules.items()), sorted(versions)]


_distributions = cache(importlib.metadata.packages_distributions)
_version = cache(importlib.metadata.version)  # which reads and parses a file


def _spec(name: str) -> ModuleSpec | None:
    """Where a module comes from; nothing is imported for it."""
    if name in sys.modules:
        return getattr(sys.modules[name], "__spec__", None)
    parent, _, _ = name.rpartition(".")
    if not parent:
        return PathFinder.find_spec(name)
    folders = getattr(_spec(parent), "submodule_search_locations", None)
    return PathFinder.find_spec(name, folders) if folders else None


class _Text(NamedTuple):
    """What a file says, to be held against what is in memory.

    Attributes:
        imports: (module, name in it), at any depth.
        bound: those at the top level, by the name that they get.
        constants: those at the top level that are written out.
        functions: the codes of each function at the top level, by its name, and in a class, by "class.name".
        plain: those of them that no decorator can make something else of.
    """

    imports: list[tuple[str, str]]
    bound: dict[str, list[tuple[str, str]]]
    constants: dict[str, Any]
    functions: dict[str, list[CodeType]]
    plain: set[str]

    def altered(self, live: Mapping[str, Any]) -> list[tuple[str, Any]]:
        """Names and values of a module in memory that are not what the file says."""
        found = {
            name: live[name]
            for name, value in self.constants.items()
            if name in live and (type(live[name]), live[name]) != (type(value), value)
        }
        for name, sources in self.bound.items():
            meant = [thing for base, part in sources for thing in _imported(base, part)]
            if name in live and meant and not any(live[name] is thing for thing in meant):
                found[name] = live[name]
        for name, versions in self.functions.items():
            owner, _, own = name.rpartition(".")
            holder = vars(live[owner]) if isinstance(live.get(owner), type) else {} if owner else live
            if own in holder and not _is_of(holder[own], versions, decorated=name not in self.plain):
                found[name] = holder[own]
        return sorted(found.items())


def _imported(base: str, part: str) -> list[Any]:
    """What ``from base import part`` may give, as far as it is imported already."""
    package, module = sys.modules.get(base), sys.modules.get(f"{base}.{part}" if part else base)
    return [*([vars(package)[part]] if package and part in vars(package) else []), *([module] if module else [])]


def _is_of(value: Any, versions: list[CodeType], *, decorated: bool) -> bool:
    """Whether a value is the function that a file defines; what a decorator makes of it beyond telling is not asked."""
    codes = _codes(inspect.unwrap(value) if decorated and callable(value) else value)
    return all(code in versions for code in codes) and (decorated or bool(codes))


def _codes(value: Any) -> list[CodeType]:
    """Of the functions that are behind a value."""
    if isinstance(value, FunctionType):
        return [value.__code__]
    if isinstance(value, property):
        return [code for part in (value.fget, value.fset, value.fdel) for code in _codes(part)]
    if isinstance(value, (staticmethod, classmethod)):
        return _codes(inspect.unwrap(value.__func__))
    if isinstance(value, functools._lru_cache_wrapper):
        return _codes(value.__wrapped__)
    if isinstance(value, (functools.cached_property, functools.partial)):
        return _codes(value.func)
    return _codes(value.py_func) if hasattr(type(value), "py_func") or is_jitted(value) else []


@cache
def _read(source: bytes, package: str) -> _Text:
    tree = ast.parse(source)
    text = _Text([], {}, {}, {}, set())
    changing: set[str] = set()

    def imported(node: ast.AST) -> list[tuple[str, tuple[str, str]]]:
        if isinstance(node, ast.Import):
            return [(alias.asname or "", (alias.name, "")) for alias in node.names]
        if isinstance(node, ast.ImportFrom):
            base = importlib.util.resolve_name("." * node.level + (node.module or ""), package)
            return [(alias.asname or alias.name, (base, alias.name)) for alias in node.names]
        return []

    for node in ast.walk(tree):
        text.imports.extend(source for _, source in imported(node))
        changing.update(node.names if isinstance(node, ast.Global) else ())
    for node in tree.body:
        for name, meant in imported(node):
            text.bound.setdefault(name, []).append(meant)
        target = node.targets[0] if isinstance(node, ast.Assign) else getattr(node, "target", None)
        if isinstance(node, (ast.Assign, ast.AnnAssign)) and isinstance(target, ast.Name) and node.value:
            with suppress(ValueError, TypeError):
                text.constants[target.id] = ast.literal_eval(node.value)
        inner = [(f"{node.name}.", part) for part in node.body] if isinstance(node, ast.ClassDef) else [("", node)]
        for owner, part in inner:
            if isinstance(part, ast.FunctionDef) and not part.decorator_list:
                text.plain.add(owner + part.name)
    for name in [name for name, value in text.constants.items() if not value or name in changing]:
        del text.constants[name]  # what begins empty is there to be filled
    for code in _inner(compile(tree, "", "exec", dont_inherit=True)):
        of_function = bool(code.co_flags & inspect.CO_OPTIMIZED)
        for name, one in [("", code)] if of_function else [(f"{code.co_name}.", method) for method in _inner(code)]:
            text.functions.setdefault(name + one.co_name, []).append(one)
    return text


def _inner(code: CodeType) -> list[CodeType]:
    return [part for part in code.co_consts if isinstance(part, CodeType)]
