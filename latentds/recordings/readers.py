"""Files of many kinds, frames and mappings as tables: named arrays, of whatever meaning."""

from __future__ import annotations

import csv
import difflib
import io
import json
import math
import os
import re
import struct
import warnings
import zlib
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .. import files

Table = dict[str, NDArray[Any]]
"""A recording as it stands: scalars, (N,), (N, k) and (K, N, n) arrays, numbers and text, by name; "" if none."""


def read_table(path: str | os.PathLike[str]) -> Table:
    """What a file holds, by name; what the names mean is not looked at.

    Raises:
        ValueError: if it is of no known kind, damaged, or larger than ``files.MAX_BYTES``, unpacked.
        FileNotFoundError: if there is no such file.
    """
    path = Path(path)
    kind = ".db3" if (path / "metadata.yaml").is_file() else path.suffix.lower()  # the folder that is a bag of ROS 2
    if kind not in READERS:
        near = difflib.get_close_matches(kind, READERS, 1)
        call = "read_excel" if kind[:4] in (".xls", ".ods") else "read_…"
        way_out = f"rename it if it is a {near[0]} file, or " if near else ""
        raise ValueError(
            f"path: expected a file of kind {' '.join(READERS)}, got {path.name!r}; {way_out}"
            f"read it with pandas and hand over the frame: Demonstration.from_table(pandas.{call}({path.name!r}))"
        )
    read, what = READERS[kind]
    if not path.exists():
        raise FileNotFoundError(f"path: no such file: {path}")
    source = path if read is _read_bag else files.read_file(path)
    try:
        return read(source)
    except ImportError as error:
        package = (error.name or str(error)).split(".")[0]
        raise ValueError(f"path: {kind} files need {package}: pip install 'latentds[recordings]'") from None
    except Exception as error:  # whatever a damaged or hostile file provokes in NumPy, SciPy, zip, json and the others
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
    table = _index_told({name: _series(source.iloc[:, i]) for i, name in enumerate(_distinct(names))})
    if all(isinstance(n, (int, np.integer)) for n in source.columns):
        table = _joined(table)
    index = _series(source.index)
    if index.dtype.kind in "fiuMm" and not counts_rows(index):
        table = {str(source.index.name or "index"): index} | table
    return table


def counts_rows(values: NDArray[Any]) -> bool:
    """Whether (N,) numbers are 0, 1, 2, … or 1, 2, 3, …"""
    return bool(values[0] in (0, 1) and (np.diff(values) == 1).all())


def _index_told(table: Table) -> Table:
    """Call a first column that has no name and counts rows what it is: the index, which pandas writes."""
    name, values = next(iter(table.items()), ("", np.zeros(0)))
    nameless = re.fullmatch(r"column 0|Unnamed: 0.*", name) and values.ndim == 1 and values.dtype.kind in "fiu"
    if not (nameless and values.size and counts_rows(values)):
        return table
    return {"row index": values} | {key: array for key, array in table.items() if key != name}


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
DAY = r"(?P<day>\d{4}([-/.])\d\d?\2\d\d?|\d\d?([-/.])\d\d?\3\d{4})"
DATE = re.compile(rf"{DAY}?[T ]?(?P<time>\d{{1,2}}:\d\d:\d\d([.,]\d+)?)(Z|[+-]00:?00)?")
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
        return _index_told(table)
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
    narrow = len(rows[-1][1]) == 1  # else a single number above, as Vicon writes the rate, begins no table
    shares = [(sum(map(_is_value, row)), sum(map(bool, row))) for _, row in rows]
    starts = [k for k, (values, filled) in enumerate(shares) if 2 * values >= max(1, filled)]
    starts = [k for k in starts if narrow or len(rows[k][1]) > 1]
    header = next((k for k, (_, row) in enumerate(rows) if _is_motive(rows) and row[0] == "Frame"), -1)
    start = next((k for k in starts if k > header), None)
    if start is None:
        raise ValueError("no row of numbers")
    lead, rows = rows[:start], rows[start:]
    width = len(rows[0][1])
    named = any(len(row) == width and row[-1] for _, row in lead)
    if not named and all(len(row) > 1 and not row[-1] for _, row in rows):  # a delimiter at the end of each line
        rows, width = [(i, row[:-1]) for i, row in rows], width - 1
    if ragged := [(i, row) for i, row in rows if len(row) != width]:
        raise ValueError(f"line {ragged[0][0]} has {len(ragged[0][1])} cells, the first of numbers {width}")
    return lead, rows


def _is_motive(rows: list[Row]) -> bool:
    """Whether it is an export of OptiTrack's Motive, whose rows of kinds, names and numbers stand above the header."""
    return bool(rows) and rows[0][1][0] == "Format Version"


def _header(lead: list[Row], comments: list[str], width: int, delimiter: str) -> list[str]:
    """Names of the columns: from the lines above the numbers, or from the last comment there; empty if none."""
    lead = [(i, row[:-1] if len(row) == width + 1 and not row[-1] else row) for i, row in lead]
    headers = [row for _, row in lead if len(row) == width]
    if _is_motive(lead):
        rows = [row for row in headers if row[0] != "Format Version" and row[1] not in ("ID", "Parent")]
        headers = [row if row[0] else ["", "", *row[2:]] for row in rows]
    if lead and len(lead[-1][1]) != width and (len(lead[-1][1]) > 1 or _is_value(lead[-1][1][0])):
        raise ValueError(f"line {lead[-1][0]} names {len(lead[-1][1])} columns, the numbers have {width}")
    if len(headers) > 1 and any(cell and below in ("", cell) for cell, below in pairwise(headers[0])):
        headers = [_joined_downward(headers)]
    if len(headers) > 2:
        raise ValueError(
            f"{len(headers)} header lines above the numbers, expected one, one of units below it, or groups of names: "
            "delete the others"
        )
    if len(headers) == 2:  # the second names units
        units = [re.sub(r"[\[\]()]", "", cell) for cell in headers[1]]
        headers = [[f"{name} [{unit}]" if unit else name for name, unit in zip(headers[0], units, strict=True)]]
    if not headers and comments:
        last = comments[-1].lstrip("#%/ ")
        headers = [row for d in (delimiter, " ") if len(row := _cells(last, d)) == width][:1]
        headers = [row for row in headers if not any(map(_is_value, row))]
    return _distinct([name or f"column {k}" for k, name in enumerate(headers[0])]) if headers else []


def _joined_downward(headers: list[list[str]]) -> list[str]:
    """One name a column of several rows, of which those above name groups, in each cell or in the first of a group."""
    filled = []
    for row, below in pairwise(headers):
        cells: list[str] = []
        for cell, under in zip(row, below, strict=True):
            cells.append(cell or (cells[-1] if cells and under else ""))
        filled.append(cells)
    names = ["/".join(filter(None, cells)) for cells in zip(*filled, headers[-1], strict=True)]
    return [name.removeprefix("Rigid Body/") for name in names]


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
        return _stamps([m for m in dates if m])
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


def _stamps(dates: list[re.Match[str]]) -> NDArray[Any]:
    """Dates as times; a ValueError if it matters, and does not show, whether the day or the month comes first."""
    days = [re.split("[-/.]", date["day"] or "1970-01-01") for date in dates]
    read = []
    for order in ((0, 1, 2),) if len(days[0][0]) == 4 else ((2, 1, 0), (2, 0, 1)):
        iso = ["-".join(day[k].zfill(2) for k in order) for day in days]
        times = ["0" * (date["time"][1] == ":") + date["time"] for date in dates]
        with suppress(ValueError):  # there is no 13th month
            read.append(np.array([f"{d}T{t}" for d, t in zip(iso, times, strict=True)], dtype="datetime64[ns]"))
    if not read:
        raise ValueError(f"{dates[0][0]!r} and those below are no dates")
    if any((np.diff(read[0]) != np.diff(other)).any() for other in read[1:]):
        raise ValueError(f"dates as {dates[0][0]!r}, day or month first: expected 2023-12-31")
    return read[0]


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
        _check_size(size)
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
        return _read_hdf5(data)
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
        _check_size(size)
        at += 8 + length


def _check_size(size: int) -> None:
    if size > files.MAX_BYTES:
        raise ValueError(f"holds at least {size} bytes, more than {files.MAX_BYTES}")


def _read_parquet(data: bytes) -> Table:
    import pyarrow
    from pyarrow import parquet, types

    file = parquet.ParquetFile(pyarrow.BufferReader(data))
    about = file.metadata
    _check_size(8 * about.num_rows * about.num_columns)
    _check_size(sum(about.row_group(i).total_byte_size for i in range(about.num_row_groups)))
    table = file.read().flatten()  # fields of structs as columns
    kept = [f.name for f in table.schema if not (types.is_struct(f.type) or types.is_binary(f.type))]  # no pictures
    return as_table(table.select(kept).to_pandas())


def _read_hdf5(data: bytes) -> Table:
    import h5py

    table: Table = {}
    matlab, size = data[:6] == b"MATLAB", 0

    def read(node: Any, name: str) -> None:
        nonlocal size
        size += getattr(node, "nbytes", 0) + 4096  # of each node too: they may hold one another
        _check_size(size)
        at, kind = f"{name}/" if name else "", node.attrs.get("MATLAB_class")
        if not matlab:
            numbers = {key: np.asarray(value) for key, value in node.attrs.items()}
            table.update(
                {at + k: number for k, number in numbers.items() if not number.ndim and number.dtype.kind in "fiu"}
            )
        if isinstance(node, h5py.Group):
            for key in node:
                if isinstance(node.get(key, getlink=True), h5py.HardLink) and key != "#refs#":  # never another file
                    read(node[key], at + key)
        elif node.external or node.is_virtual:
            raise ValueError(f"the numbers of {name} are in another file")
        elif h5py.check_ref_dtype(node.dtype):  # a cell array, or a field of an array of structs, of MATLAB
            head, _, field = name.rpartition("/")
            for i, reference in enumerate(node[()].flat):
                read(file[reference], f"{at}{i}" if kind else f"{head}/{i}/{field}")
        elif kind == b"char":
            table[name] = np.array("".join(map(chr, node[()].T.flat)))
        elif h5py.check_string_dtype(node.dtype):
            table[name] = np.array(node.asstr()[()], dtype=str)
        elif node.ndim <= 3 and "MATLAB_empty" not in node.attrs:  # no pictures
            table.update(_flattened(node[()].T.squeeze() if matlab else node[()], name))

    with h5py.File(io.BytesIO(data)) as file:
        read(file, "")
    return table


POSES = ("PoseStamped", "PoseWithCovarianceStamped", "TransformStamped", "Odometry")


def _read_bag(path: Path) -> Table:
    """The joints' states and the poses of a bag, each under its topic if there are several."""
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    parts = list(path.iterdir()) if path.is_dir() else [path]
    if any(not (part.is_file() or part.is_dir()) for part in parts):
        raise ValueError("expected regular files")
    size = sum(part.stat().st_size for part in parts)
    _check_size(size)
    series: dict[tuple[str, tuple[str, ...]], list[dict[str, Any]]] = defaultdict(list)
    orders: dict[frozenset[str], tuple[str, ...]] = {}  # of the joints' names; publishers may take turns
    with AnyReader([path], default_typestore=get_typestore(Stores.LATEST)) as bag:
        kinds = {c.topic: c.msgtype.split("/")[-1] for c in bag.connections}
        if not (known := [c for c in bag.connections if kinds[c.topic] in ("JointState", *POSES)]):
            seen = ", ".join(f"{topic} ({kind})" for topic, kind in kinds.items())
            raise ValueError(f"expected a topic of JointState, {', '.join(POSES)}, got {seen or 'none'}")
        for connection, received, raw in bag.messages(known):
            size += len(raw)
            _check_size(size)
            message: Any = bag.deserialize(raw, connection.msgtype)
            stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
            row: dict[str, Any] = {"stamp": stamp or received}
            if kinds[connection.topic] == "JointState":
                which = orders.setdefault(frozenset(message.name), tuple(message.name))
                order = [message.name.index(name) for name in which]
                for quantity in ("position", "velocity", "effort"):
                    values = getattr(message, quantity)
                    row[quantity] = values[order] if len(values) == len(order) else np.full(len(order), math.nan)
            else:
                pose = message.pose if hasattr(message, "pose") else message.transform
                pose, which = getattr(pose, "pose", pose), (getattr(message, "child_frame_id", "pose"),)
                for part in ("position", "orientation", "translation", "rotation"):
                    axes = [axis for axis in "xyzw" if hasattr(getattr(pose, part, None), axis)]
                    row |= {f"{part}/{axis}": getattr(getattr(pose, part), axis) for axis in axes}
            series[connection.topic, which].append(row)
    table: Table = {}
    topics = Counter(topic for topic, _ in series)
    for (topic, which), rows in series.items():
        at = f"{topic.strip('/')}/" * (len(series) > 1) + f"{which[0]}/" * (topics[topic] > 1)  # robots share topics
        columns = {name: np.array([row[name] for row in rows]) for name in rows[0]}
        columns = {name: a for name, a in columns.items() if a.size and not np.isnan(a).all()}
        columns["stamp"] = columns["stamp"].astype("datetime64[ns]")
        columns |= {"name": np.array(which)} if kinds[topic] == "JointState" else {}
        table |= {at + name: array for name, array in columns.items()}
    return table


def _read_c3d(data: bytes) -> Table:
    import c3d

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        reader = c3d.Reader(io.BytesIO(data))
        count, used = reader.last_frame - reader.first_frame + 1, reader.point_used
        if not (count > 0 and used):
            raise ValueError("no points")
        _check_size(20 * count * used)  # before it ends early
        points = np.array([points[:, :4] for _, points, _ in reader.read_frames()], dtype=np.float64)
    if len(points) != count:
        raise ValueError(f"{len(points)} rows of {count}")
    points[points[:, :, 3] < 0] = math.nan  # nobody saw them
    labels = [label.strip() for label in reader.get("POINT:LABELS").string_array][:used]
    labels += [f"point {k}" for k in range(len(labels), used)]
    columns = {
        f"{label}/{axis}": points[:, i, k] for i, label in enumerate(_distinct(labels)) for k, axis in enumerate("xyz")
    }
    return columns | {"rate": np.array(float(reader.point_rate))}


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
        if any(isinstance(part, np.ndarray) and part.ndim == 2 for part in value[0].values()):  # several motions
            return _flattened(dict(enumerate(value)), name)
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
    return {name: array[0] if array.ndim == 3 and len(array) == 1 else array}


READERS: dict[str, tuple[Callable[[Any], Table], str]] = {
    **dict.fromkeys((".csv", ".tsv", ".txt", ".dat", ".log"), (_read_text, "a table of numbers")),
    ".npy": (_read_npy, "a readable .npy without pickles"),
    ".npz": (_read_npz, "a readable .npz without pickles"),
    ".mat": (_read_mat, "a readable .mat"),
    ".json": (lambda data: _flattened(json.loads(_decoded(data))), "a readable .json of numbers"),
    ".parquet": (_read_parquet, "a readable .parquet"),
    **dict.fromkeys((".h5", ".hdf5"), (_read_hdf5, "a readable HDF5 file of numbers")),
    **dict.fromkeys((".bag", ".db3", ".mcap"), (_read_bag, "a readable bag of ROS")),
    ".c3d": (_read_c3d, "a readable .c3d"),
}
