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

from .. import files

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


Row = tuple[int, list[str]]
"""The number of a line, from 1, and its cells."""
COMMA_NUMBER = re.compile(r"[+-]?\d*,\d+([eE][+-]?\d+)?")
DATE = re.compile(r"(\d{4}-\d\d-\d\d)?[T ]?(\d{1,2}:\d\d:\d\d([.,]\d+)?)(Z|[+-]00:?00)?")
MISSING_CELLS = {"", "na", "n/a", "nan", "null", "none", "-", "--"}


def _read_text(data: bytes) -> Table:
    lines = [(i, line.rstrip("\n")) for i, line in enumerate(io.StringIO(_decoded(data), newline=None), 1)]
    separator = re.fullmatch("sep=(.)", lines[0][1]) if lines else None
    lines = lines[1:] if separator else lines
    comments = {i: line.strip() for i, line in lines if line.lstrip().startswith(("#", "%", "//"))}
    body = [(i, line) for i, line in lines if i not in comments and line.strip(" \t,;\x1a")]
    if not body:
        raise ValueError("no rows")
    delimiter = separator[1] if separator else _delimiter(body[-1][1])
    lead, rows = _at_the_first_of_numbers([(i, _cells(line, delimiter)) for i, line in body])
    numbers, width = [i for i, _ in rows], len(rows[0][1])
    names = _header(lead, [text for i, text in comments.items() if i < numbers[0]], width, delimiter)
    columns = [[row[k] for _, row in rows] for k in range(width)]
    comma = _decimal_comma(columns, delimiter)
    named = zip(names or map(str, range(width)), columns, strict=True)
    table = {name: _parsed(name, cells, numbers, comma) for name, cells in named}
    if names:
        return table
    numbered = width > 2 and rows[0][1] == list(table)
    if numbered and all("." in cell for _, row in rows[1:] for cell in row):
        raise ValueError(f"line {numbers[0]} numbers the columns: expected names in it, or none")
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


def _delimiter(line: str) -> str:
    """What separates the cells of a line of numbers: a tab, a semicolon, a comma or blanks."""
    outside = re.sub(r'"[^"]*"|\[[^\]]*\]|\([^)]*\)', "0", line.strip())
    if mark := next((mark for mark in "\t;" if mark in outside), ""):
        return mark
    words = outside.split()
    decimal = len(words) > 1 and all(re.fullmatch(r"[+-]?\d+(,\d+)?([eE][+-]?\d+)?", w) for w in words)
    return "," if "," in outside and not decimal else " "


def _cells(line: str, delimiter: str) -> list[str]:
    if delimiter == " ":
        line = re.sub(r"\s+", " ", line.strip())
    (row,) = csv.reader([line], delimiter=delimiter, skipinitialspace=True)
    return [cell.strip() for cell in row]


def _at_the_first_of_numbers(rows: list[Row]) -> tuple[list[Row], list[Row]]:
    """The rows above the numbers, and those of numbers, all as wide."""
    shares = [(sum(map(_is_value, row)), sum(map(bool, row))) for _, row in rows]
    start = next((k for k, (values, filled) in enumerate(shares) if 2 * values >= max(1, filled)), None)
    if start is None:
        raise ValueError("no row of numbers")
    lead, rows = rows[:start], rows[start:]
    if all(len(row) > 1 and not row[-1] for _, row in rows):  # a delimiter at the end of each line
        rows = [(i, row[:-1]) for i, row in rows]
    width = len(rows[0][1])
    if ragged := [(i, row) for i, row in rows if len(row) != width]:
        raise ValueError(f"line {ragged[0][0]} has {len(ragged[0][1])} cells, the first of numbers {width}")
    return lead, rows


def _header(lead: list[Row], comments: list[str], width: int, delimiter: str) -> list[str]:
    """Names of the columns: from the lines above the numbers, or from the last comment there; empty if none."""
    lead = [(i, row[:-1] if len(row) == width + 1 and not row[-1] else row) for i, row in lead]
    headers = [row for _, row in lead if len(row) == width]
    if lead and len(lead[-1][1]) not in (1, width):
        raise ValueError(f"line {lead[-1][0]} names {len(lead[-1][1])} columns, the numbers have {width}")
    if len(headers) > 2:
        raise ValueError(f"{len(headers)} header lines above the numbers, expected one, and one of units at most")
    if len(headers) == 2:  # the second names units
        units = [re.sub(r"[\[\]()]", "", cell) for cell in headers[1]]
        headers = [[f"{name} [{unit}]" if unit else name for name, unit in zip(headers[0], units, strict=True)]]
    if not headers and comments:
        last = comments[-1].lstrip("#%/ ")
        headers = [row for d in (delimiter, " ") if len(row := _cells(last, d)) == width][:1]
        headers = [row for row in headers if not any(map(_is_value, row))]
    return _distinct([name or f"column {k}" for k, name in enumerate(headers[0])]) if headers else []


def _distinct(names: list[str]) -> list[str]:
    """Names that occur again with their count behind them."""
    seen: Counter[str] = Counter()
    distinct = []
    for name in names:
        seen[name] += 1
        distinct.append(f"{name} ({seen[name]})" if seen[name] > 1 else name)
    return distinct


def _decimal_comma(columns: list[list[str]], delimiter: str) -> bool:
    """Whether numbers are written 0,5; a ValueError if a comma stands for both."""
    cells = [cell for column in columns for cell in column]
    if delimiter == "," and any(re.fullmatch(r"[+-]?0\d+", cell) for cell in cells):
        raise ValueError("decimal commas between commas cannot be told apart: expected another delimiter")
    if not any(map(COMMA_NUMBER.fullmatch, cells)):
        return False
    if pointed := [c for c in cells if "." in c and _is_value(c) and not DATE.fullmatch(c) and c[:1] not in "[("]:
        raise ValueError(f"numbers with a decimal comma and, as {pointed[0]!r}, with a point")
    return True


def _is_value(cell: str) -> bool:
    """Whether a cell is a number, a list or a date, and not a name."""
    if _is_list(cell) or DATE.fullmatch(cell):
        return bool(re.search(r"\d", cell))
    try:
        float(cell.replace(",", ".", 1))
    except ValueError:
        return False
    return "_" not in cell


def _is_list(cell: str) -> bool:
    return cell.startswith(("[", "(", "array("))


def _parsed(name: str, cells: list[str], lines: list[int], comma: bool) -> NDArray[Any]:
    """A column, whose cells stand in ``lines``; a ValueError if some are words among numbers."""
    column = _column([cell.replace(",", ".") for cell in cells] if comma and "[" not in cells[0] else cells)
    if column.dtype.kind == "U" and column.ndim == 1:
        values = [_is_value(cell) for cell in cells]
        if any(values) and any(cell and not value for cell, value in zip(cells, values, strict=True)):
            row = values.index(False)
            raise ValueError(f"line {lines[row]}: {cells[row]!r} among the numbers of column {name!r}")
    return column


def _column(cells: list[str]) -> NDArray[Any]:
    """Cells of text as (N,) numbers, times or text, or (N, k) numbers or text if they are lists."""
    dates = [DATE.fullmatch(cell.replace(",", ".")) for cell in cells]
    if all(dates):
        iso = [f"{m[1] or '1970-01-01'}T{'0' * (m[2][1] == ':')}{m[2]}" for m in dates if m]
        return np.array(iso, dtype="datetime64[ns]")
    if all(map(_is_list, cells)):
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
        return np.array([math.nan if cell.lower() in MISSING_CELLS else float(cell) for cell in cells])
    except ValueError:
        return np.array(cells, dtype=str)


def _joined(table: Table) -> Table:
    """Columns without names as one array without a name."""
    arrays = list(table.values())
    if not arrays or not all(a.ndim == 1 and a.dtype.kind in "fiu" for a in arrays):
        return table
    return {"": np.stack(arrays, axis=1)}


def _read_npy(data: bytes) -> Table:
    array = np.load(io.BytesIO(data), allow_pickle=False)
    if not isinstance(array, np.ndarray):
        raise ValueError("an archive")
    return _flattened(array)


def _read_npz(data: bytes) -> Table:
    arrays, pickled = {}, []
    with np.load(io.BytesIO(data), allow_pickle=False) as file:
        size = sum(entry.file_size for entry in file.zip.infolist())  # unpacked
        if size > files.MAX_BYTES:
            raise ValueError(f"holds {size} bytes, more than {files.MAX_BYTES}")
        for key in file.files:
            try:
                arrays[key] = file[key]
            except ValueError as error:
                if "allow_pickle" not in str(error):
                    raise
                pickled.append(key)
    table = _flattened({k: a for k, a in arrays.items() if isinstance(a, np.ndarray)})
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
    ".json": (lambda data: _flattened(json.loads(_decoded(data))), "a readable .json of numbers"),
}
