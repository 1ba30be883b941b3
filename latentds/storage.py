"""Systems from files: safetensors, with JSON beside the numbers. Loading runs and imports nothing that a file names."""

from __future__ import annotations

import inspect
import json
import math
import os
from collections.abc import Sequence
from dataclasses import fields, is_dataclass
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

import torch

from .base import FORMAT, MovedDS, StableDS
from .files import read_tensors
from .methods.chebyshev import ChebyshevDS
from .methods.tube import TubeDS

SLACK = 1000
"""A file may ask for this many times as many numbers as it holds, not more: its sizes are not to be trusted."""


def load(path: str | os.PathLike[str], *, classes: Sequence[type[StableDS]] = ()) -> StableDS:
    """Read a system that :meth:`StableDS.save` wrote, from a source that need not be trusted.

    Nothing that the file names is imported or run: its class is looked up by name among ChebyshevDS, TubeDS, MovedDS
    and ``classes``. Whether what was loaded is stable is for :func:`latentds.certify` to say.

    Args:
        path: of the file.
        classes: further classes that it may hold, such as those in ``baselines`` or your own.

    Raises:
        ValueError: if the file is damaged, of another kind, of a newer format, or holds another class.
        FileNotFoundError: if there is no such file.
    """
    text, state = read_tensors(path)
    known: dict[str, type[StableDS]] = {"ChebyshevDS": ChebyshevDS, "MovedDS": MovedDS, "TubeDS": TubeDS}
    known |= {allowed.__name__: allowed for allowed in classes}
    try:
        return _rebuilt(text, state, known)
    except (KeyError, TypeError, RuntimeError, AttributeError, RecursionError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise ValueError(f"path: {Path(path).name} does not hold a system that can be loaded: {reason}") from None


def _rebuilt(text: str, state: dict[str, torch.Tensor], known: dict[str, type[StableDS]]) -> StableDS:
    header = json.loads(text)
    if not isinstance(header, dict) or type(header.get("format")) is not int:
        raise ValueError("expected a format number in its metadata, got none")
    if header["format"] != FORMAT:
        age = "a newer" if header["format"] > FORMAT else "an older"
        raise ValueError(f"expected format {FORMAT}, got {header['format']}: it needs {age} latentds")
    if not all(bool(torch.isfinite(value).all()) for value in state.values() if value.is_floating_point()):
        raise ValueError("expected finite numbers, got NaN or inf")
    if any(value.is_complex() for value in state.values()):
        raise ValueError("expected real numbers, got complex ones")
    with torch.random.fork_rng(devices=[]):  # an unseeded constructor draws numbers, only to have them replaced
        ds = _made(header, known, sum(value.numel() for value in state.values()))
    dtype = state["attractor"].dtype
    if dtype not in (torch.float64, torch.float32):
        raise ValueError(f"expected an attractor in float64 or float32, got {dtype}")
    ds.to(dtype).load_state_dict(state)
    ds.fit_report = None if header["report"] is None else _typed(header["report"], ds.report_type, "report")
    return ds


def _made(header: dict[str, Any], known: dict[str, type[StableDS]], held: int) -> StableDS:
    """A system by its class and settings, those of a system in it likewise, that so many stored numbers can fill."""
    if header["class"] not in known:
        raise ValueError(
            f"expected a class among {sorted(known)}, got {header['class']!r:.80}; allow others by classes=[…]"
        )
    settings: Any = header["settings"]
    wanted = inspect.signature(known[header["class"]]).parameters
    if not isinstance(settings, dict) or set(settings) != set(wanted):
        raise ValueError(f"expected the settings {sorted(wanted)}, got {settings!r:.200}")
    sizes = [v for k, v in settings.items() if (k == "dim" or k.startswith("n_")) and isinstance(v, int)]
    room = _dim_inside(header) ** 2 > held if header["class"] == "MovedDS" else False  # its rotation's numbers
    if room or math.prod(max(size, 1) for size in sizes) > SLACK * max(held, 1):
        raise ValueError(f"expected sizes that {held} stored numbers can fill, got {settings!r:.200}")
    settings = {
        name: _made(value, known, held) if isinstance(value, dict) else value for name, value in settings.items()
    }
    return known[header["class"]](**settings)


def _dim_inside(header: dict[str, Any]) -> int:
    """n of the system that a moved one holds."""
    settings = header["settings"]
    return int(settings["dim"]) if "dim" in settings else _dim_inside(settings["ds"])


def _typed(value: Any, wanted: Any, name: str) -> Any:
    """What JSON told, as the type that it had: a dataclass, tuple, number, string or boolean, or None beside one."""
    inner = get_args(wanted)
    if get_origin(wanted) in (Union, UnionType):
        return None if value is None else _typed(value, next(kind for kind in inner if kind is not NoneType), name)
    if isinstance(value, dict) and is_dataclass(wanted) and isinstance(wanted, type):
        types = get_type_hints(wanted)
        if odd := sorted(set(value) ^ {part.name for part in fields(wanted)}):
            raise ValueError(f"{name}: expected the fields of {wanted.__name__}, got unknown or missing ones: {odd}")
        return wanted(**{key: _typed(part, types[key], key) for key, part in value.items()})
    if isinstance(value, list) and get_origin(wanted) is tuple:
        each = inner[:1] * len(value) if inner[-1] is ... else inner
        if len(each) == len(value):
            return tuple(_typed(part, kind, name) for part, kind in zip(value, each, strict=True))
    if type(value) is not wanted and (type(value), wanted) != (int, float):
        raise ValueError(f"{name}: expected {wanted}, got {value!r:.80}")
    return wanted(value)
