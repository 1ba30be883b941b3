"""Files of many kinds, frames and mappings as tables: named arrays, of whatever meaning."""

from __future__ import annotations

import csv
import io
import json
import math
import os
import re
import struct
import zlib
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import files

Table = dict[str, NDArray[Any]]
"""A recording as it stands: scalars, (N,) and (N, k) arrays, numbers and text, by name; "" if it has none."""


def read_table(path: str | os.PathLike[str]) -> Table:
    """What a file holds, by name; what the names mean is not looked at.

    Raises:
        ValueError: if it is of no known kind, damaged, or larger than ``files.MAX_BYTES``, unpacked.
        FileNotFoundError: if there is no such file.
    """
    path = Path(path)
    if path.suffix.lower() not in READERS:
        raise ValueError(
            f"path: expected a file of kind {' '.join(READERS)}, got {path.name!r}; "
            "read others with pandas and hand over the frame: Demonstration.from_table(frame)"
        )
    read, what = READERS[path.suffix.lower()]
    data = files.read_file(path)
    try:
        return read(data)
    except Exception as error:  # whatever a damaged or hostile file provokes in NumPy, SciPy, zip and json
        raise ValueError(f"path: {path.name} is not {what} ({error})") from None


def as_table(source: Any) -> Table:
    """A pandas frame, or a mapping from names to arrays, as a table.

    Raises:
        ValueError: if it is neither.
    """
    if isinstance(source, Mapping):
        return _flattened(source)
    if not all(hasattr(source, part) for part in ("columns", "index", "iloc")):
        raise ValueError(f"table: expected a pandas frame or a mapping to arrays, got {type(source).__name__}")
    names = ["/".join(map(str, n)) if isinstance(n, tuple) else str(n) for n in source.columns]
    table = {name: _series(source.iloc[:, i]) for i, name in enumerate(_distinct(names))}
    if all(isinstance(n, (int, np.integer)) for n in source.columns):
        table = _joined(table)
    index = _series(source.index)
    if index.dtype.kind in "fiuMm" and not counts_rows(index):
        table = {str(source.index.name or "index"): index} | table
    return table


def counts_rows(values: NDArray[Any]) -> bool:
    """Whether (N,) numbers are 0, 1, 2, … or 1, 2, 3, …"""
    return bool(values[0] in (0, 1) and (np.diff(values) == 1).all())


def _series(series: Any) -> NDArray[Any]:
    if getattr(series.dtype, "tz", None) is not None:
        series = series.dt.tz_convert(None) if hasattr(series, "dt") else series.tz_convert(None)
    values = series.to_numpy()
    if values.dtype.kind in "fiubMm":
        return np.asarray(values)
    cells = list(values)
    if all(isinstance(c, str) for c in cells):
        return _column(cells)
    if any(np.ndim(c) for c in cells):
        return np.array([list(c) for c in cells])
    return np.array([float("nan" if c is None or str(c) in ("<NA>", "NaT") else c) for c in cells])


def _read_text(data: bytes) -> Table:
    numbered = [(i, line.rstrip("\r\n")) for i, line in enumerate(io.StringIO(_decoded(data), newline=None), 1)]
    hint = [line for _, line in numbered[:1] if re.fullmatch(r"sep=.", line)]
    comments = [(i, line.strip()) for i, line in numbered if line.lstrip().startswith(("#", "%", "//"))]
    skipped = {i for i, _ in comments} | ({1} if hint else set())
    body = [(i, line) for i, line in numbered if i not in skipped and line.strip(" \t,;\x1a")]
    if not body:
        raise ValueError("no rows")
    delimiter = hint[0][-1] if hint else _delimiter(body[-1][1])
    rows = [(i, _cells(line, delimiter)) for i, line in body]
    start = next(
        (k for k, (_, row) in enumerate(rows) if 2 * sum(map(_is_value, row)) >= max(1, sum(map(bool, row)))), None
    )
    if start is None:
        raise ValueError("no row of numbers")
    lead, rows = rows[:start], rows[start:]
    if all(len(row) > 1 and not row[-1] for _, row in rows):  # a delimiter at the end of each line
        rows = [(i, row[:-1]) for i, row in rows]
    width = len(rows[0][1])
    for i, row in rows:
        if len(row) != width:
            raise ValueError(f"line {i} has {len(row)} cells, the first of numbers {width}")
    names = _header(lead, comments, rows[0][0], width, delimiter)
    table = {}
    cells = [[row[k] for _, row in rows] for k in range(width)]
    comma = _decimal_comma(cells, delimiter)
    for k, column in enumerate(cells):
        name = names[k] if names else str(k)
        array = _column([c.replace(",", ".") for c in column] if comma and "[" not in column[0] else column)
        if array.dtype.kind == "U" and array.ndim == 1:
            numbers = [_is_value(c) for c in column]
            if any(numbers) and not all(not c or n for c, n in zip(column, numbers, strict=True)):
                bad = numbers.index(False)
                raise ValueError(f"line {rows[bad][0]}: {column[bad]!r} among the numbers of column {name!r}")
        table[name] = array
    if names:
        return table
    first = rows[0][1]
    if width > 2 and first == [str(k) for k in range(width)] and all("." in c for _, row in rows[1:] for c in row):
        raise ValueError(f"line {rows[0][0]} numbers the columns: expected names in it, or none")
    return _joined(table)


def _decoded(data: bytes) -> str:
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return data.decode("utf-16")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = data.decode("cp1252")  # as spreadsheets write an umlaut or µ
    if "\x00" in text:
        raise ValueError("binary")
    return text


COMMA_NUMBER = re.compile(r"[+-]?\d*,\d+([eE][+-]?\d+)?")
DATE = re.compile(r"(\d{4}-\d\d-\d\d)?[T ]?(\d{1,2}:\d\d:\d\d([.,]\d+)?)(Z|[+-]00:?00)?")
MISSING = {"", "na", "n/a", "nan", "null", "none", "-", "--"}


def _delimiter(line: str) -> str:
    """What separates the cells of a line of numbers: a tab, a semicolon, a comma or blanks."""
    outside = re.sub(r'"[^"]*"|\[[^\]]*\]|\([^)]*\)', "0", line.strip())
    if "\t" in outside:
        return "\t"
    if ";" in outside:
        return ";"
    words = outside.split()
    decimal = len(words) > 1 and all(re.fullmatch(r"[+-]?\d+(,\d+)?([eE][+-]?\d+)?", w) for w in words)
    return "," if "," in outside and not decimal else " "


def _cells(line: str, delimiter: str) -> list[str]:
    if delimiter == " ":
        line = re.sub(r"\s+", " ", line.strip())
    (row,) = csv.reader([line], delimiter=delimiter, skipinitialspace=True)
    return [cell.strip() for cell in row]


def _header(
    lead: list[tuple[int, list[str]]], comments: list[tuple[int, str]], first: int, width: int, delimiter: str
) -> list[str]:
    """Names of the columns: from the lines above the numbers, or from the last comment there; empty if none."""
    trimmed = [(i, row[:-1] if len(row) == width + 1 and not row[-1] else row) for i, row in lead]
    fitting = [row for _, row in trimmed if len(row) == width]
    if trimmed and (len(fitting) > 2 or (len(trimmed[-1][1]) not in (1, width))):
        i, row = trimmed[-1]
        raise ValueError(
            f"line {i} names {len(row)} columns, the numbers have {width}"
            if len(row) != width
            else f"{len(fitting)} header lines above the numbers, expected one, and one of units at most"
        )
    if len(fitting) == 2:  # the second names units
        units = [re.sub(r"[\[\]()]", "", cell) for cell in fitting[1]]
        fitting = [[f"{name} [{unit}]" if unit else name for name, unit in zip(fitting[0], units, strict=True)]]
    above = [text.lstrip("#%/ ") for i, text in comments if i < first]
    if not fitting and above:
        row = next((r for d in (delimiter, " ") if len(r := _cells(above[-1], d)) == width), [])
        fitting = [row] if row and not any(map(_is_value, row)) else []
    return _distinct([name or f"column {k}" for k, name in enumerate(fitting[0])]) if fitting else []


def _distinct(names: list[str]) -> list[str]:
    seen: Counter[str] = Counter()
    found = []
    for name in names:
        seen[name] += 1
        found.append(name if seen[name] == 1 else f"{name} ({seen[name]})")
    return found


def _decimal_comma(cells: list[list[str]], delimiter: str) -> bool:
    """Whether numbers are written 0,5; a ValueError if a comma stands for both."""
    flat = [cell for column in cells for cell in column]
    if delimiter == "," and any(re.fullmatch(r"[+-]?0\d+", cell) for cell in flat):
        raise ValueError("decimal commas between commas cannot be told apart: expected another delimiter")
    if not any(COMMA_NUMBER.fullmatch(cell) for cell in flat):
        return False
    if mixed := [c for c in flat if "." in c and _is_value(c) and not DATE.fullmatch(c) and c[:1] not in "[("]:
        raise ValueError(f"numbers with a decimal comma and, as {mixed[0]!r}, with a point")
    return True


def _is_value(cell: str) -> bool:
    """Whether a cell is a number, a list or a date, and not a name."""
    if cell[:1] in ("[", "(") or cell.startswith("array(") or DATE.fullmatch(cell):
        return bool(re.search(r"\d", cell))
    try:
        float(cell.replace(",", ".", 1))
    except ValueError:
        return False
    return "_" not in cell


def _column(cells: list[str]) -> NDArray[Any]:
    """Cells of text as (N,) numbers, times or text, or (N, k) numbers or text if they are lists."""
    if all(DATE.fullmatch(cell) for cell in cells) and cells:
        found = [DATE.fullmatch(cell.replace(",", ".")) for cell in cells]
        return np.array(
            [f"{m[1] or '1970-01-01'}T{'0' * (m[2][1] == ':')}{m[2]}" if m else "NaT" for m in found],
            dtype="datetime64[ns]",
        )
    if all(cell[:1] in ("[", "(") or cell.startswith("array(") for cell in cells):
        inside = [re.sub(r"^[^\[(]*[\[(]+('[a-z]', *\[)?|[\])]+$", "", cell) for cell in cells]
        lists = [[item.strip("'\" ") for item in re.split(r"[,;\s]+", text.strip()) if item] for text in inside]
        if len({len(row) for row in lists}) != 1:
            return np.array(cells, dtype=str)
        try:
            return np.array(lists, dtype=np.float64)
        except ValueError:
            return np.array(lists, dtype=str)
    try:
        if any("_" in cell for cell in cells):
            raise ValueError
        return np.array([math.nan if cell.lower() in MISSING else float(cell) for cell in cells])
    except ValueError:
        return np.array(cells, dtype=str)


def _joined(table: Table) -> Table:
    """Columns without names as one array without a name."""
    arrays = list(table.values())
    if not all(a.ndim == 1 and a.dtype.kind in "fiu" for a in arrays):
        return table
    return {"": np.stack(arrays, axis=1)}


def _read_npy(data: bytes) -> Table:
    array = np.load(io.BytesIO(data), allow_pickle=False)
    if not isinstance(array, np.ndarray):
        raise ValueError("an archive")
    return _flattened(array)


def _read_npz(data: bytes) -> Table:
    found, pickled = {}, []
    with np.load(io.BytesIO(data), allow_pickle=False) as file:
        size = sum(entry.file_size for entry in file.zip.infolist())  # unpacked
        if size > files.MAX_BYTES:
            raise ValueError(f"holds {size} bytes, more than {files.MAX_BYTES}")
        for key in file.files:
            try:
                found[key] = file[key]
            except ValueError as error:
                if "allow_pickle" not in str(error):
                    raise
                pickled.append(key)
    table = _flattened({k: a for k, a in found.items() if isinstance(a, np.ndarray)})
    if pickled and not any(a.ndim for a in table.values()):
        raise ValueError(f"pickled: {', '.join(pickled)}")
    return table


def _read_mat(data: bytes) -> Table:
    from scipy.io import loadmat  # half a second that only these files need

    if data[:8] == b"\x89HDF\r\n\x1a\n" or data[:10] == b"MATLAB 7.3":
        raise ValueError("version 7.3: expected save('file.mat', …, '-v7')")
    _check_unpacked(data)
    variables = loadmat(io.BytesIO(data), simplify_cells=True)
    return _flattened({k: v for k, v in variables.items() if not k.startswith("__")})


def _check_unpacked(data: bytes) -> None:
    """Refuse a .mat file whose compressed variables unpack to more than ``files.MAX_BYTES``."""
    at, size = 128, len(data)
    order = "<" if data[126:128] == b"IM" else ">"
    while at + 8 <= len(data) and data[126:128] in (b"IM", b"MI"):
        kind, length = struct.unpack_from(f"{order}II", data, at)
        if kind == 15:  # miCOMPRESSED
            packed, unpacking = data[at + 8 : at + 8 + length], zlib.decompressobj()
            while packed and not unpacking.eof and size <= files.MAX_BYTES:
                size += len(unpacking.decompress(packed, 2**20))
                packed = unpacking.unconsumed_tail
        if size > files.MAX_BYTES:
            raise ValueError(f"holds more than {files.MAX_BYTES} bytes, unpacked")
        at += 8 + length


def _read_json(data: bytes) -> Table:
    return _flattened(json.loads(_decoded(data)))


def _flattened(value: Any, name: str = "") -> Table:
    """Nested mappings and lists as one table; the names of nested ones are joined by a slash."""
    if isinstance(value, np.ndarray) and value.dtype.names:
        value = {field: value[field] for field in value.dtype.names}
    if isinstance(value, np.ndarray) and value.dtype.kind == "O":
        value = value.tolist()
    if isinstance(value, Mapping):
        parts = {f"{name}/{key}" if name else str(key): part for key, part in value.items()}
        return {key: array for each, part in parts.items() for key, array in _flattened(part, each).items()}
    if isinstance(value, list) and value and all(isinstance(item, Mapping) for item in value):
        if any(item.keys() != value[0].keys() for item in value):
            raise ValueError(f"the records of {name or 'the list'} differ in their names")
        return _flattened({key: [item[key] for item in value] for key in value[0]}, name)
    if value is None or isinstance(value, (bool, bytes)):
        return {}
    if isinstance(value, list) and value and all(isinstance(item, str) for item in value):
        return {name: _column(value)}
    try:
        array = np.asarray([math.nan if item is None else item for item in value] if isinstance(value, list) else value)
    except ValueError:  # ragged: several motions
        return {k: a for i, item in enumerate(value) for k, a in _flattened(item, f"{name}/{i}").items()}
    if array.dtype.kind == "O" and isinstance(value, list):
        raise ValueError(f"{name or 'the list'} holds more than numbers")
    return {name: array}


READERS: dict[str, tuple[Callable[[bytes], Table], str]] = {
    **dict.fromkeys((".csv", ".tsv", ".txt", ".dat"), (_read_text, "a table of numbers")),
    ".npy": (_read_npy, "a readable .npy without pickles"),
    ".npz": (_read_npz, "a readable .npz without pickles"),
    ".mat": (_read_mat, "a readable .mat"),
    ".json": (_read_json, "a readable .json of numbers"),
}
