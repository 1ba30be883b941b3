"""Interrupted runs go on where they stopped, and a cell that changed is not mistaken for the old one."""

import functools
import importlib
import os
import signal
import sqlite3
import subprocess
import sys
import threading
import time

import numba
import numpy as np
import pytest
import torch

from baselines import FDM, SDSEF
from experiments import kill
from latentds import ChebyshevDS, Demonstration, TubeDS, cache, datasets, report
from latentds.benchmark import Cell, RolloutProtocol, _key, compare, run
from latentds.cache import CellStore, UnreadableError, fingerprint

SPIRAL = datasets.unstable_spiral(1, 60)
QUICK = {"n_starts": 1, "n_points": 30, "n_jobs": 1}
TIMES = ["fit_seconds", "rollout_seconds"]


@pytest.fixture
def file(tmp_path):
    return tmp_path / "cells.sqlite"


def counting(made):
    def factory(dim):
        made.append(dim)
        return FDM(dim, n_layers=5)

    return factory


def test_a_store_gives_back_what_it_got(file):
    rows = ({"method": "a", "demonstration": "b", "seed": 0, "dtw": 0.1 + 0.2, "nan": float("nan"), "ok": True},)
    paths = np.random.default_rng(0).standard_normal((2, 5, 3))
    paths[0] = np.nan
    with CellStore(file) as store:
        assert store.get("key") is None
        store.put("key", rows, paths)
        store.put("key", ({**rows[0], "dtw": 7.0},), paths)  # the first stays
    with CellStore(file) as store:
        found, moved = store.get("key")
        assert store.keys() == {"key"}
        assert len(store) == 1
    assert repr(found) == repr(rows)
    assert np.array_equal(moved, paths, equal_nan=True)


def test_a_second_run_computes_nothing_and_gives_the_same_rows(file):
    first = compare({"FDM": counting([]), "Chebyshev": ChebyshevDS}, SPIRAL, store=file, **QUICK)
    made = []
    again = compare({"FDM": counting(made), "Chebyshev": ChebyshevDS}, SPIRAL, store=file, **QUICK)
    assert len(made) == 2  # to see whether it can be made and to know its settings, not to fit
    assert first.equals(again)  # times included: they are the first run's
    without = compare({"FDM": counting([]), "Chebyshev": ChebyshevDS}, SPIRAL, **QUICK)
    assert first.drop(columns=TIMES).equals(without.drop(columns=TIMES))


def test_paths_come_back(file):
    cells = [Cell("FDM", lambda dim: FDM(dim, n_layers=5), SPIRAL)]
    (first,) = run(cells, RolloutProtocol(n_starts=1), n_jobs=1, store=file)
    (again,) = run(cells, RolloutProtocol(n_starts=1), n_jobs=1, store=file)
    assert np.array_equal(first.paths, again.paths)


def test_a_run_that_stops_keeps_what_it_has(file):
    methods = {str(i): (lambda dim, i=i: FDM(dim, n_layers=i)) for i in range(1, 7)}
    cells = [Cell(label, factory, SPIRAL) for label, factory in methods.items()]
    outcomes = run(cells, RolloutProtocol(**{k: QUICK[k] for k in ("n_starts", "n_points")}), n_jobs=1, store=file)
    seen = {next(outcomes).method, next(outcomes).method}
    outcomes.close()
    with CellStore(file) as store:
        assert len(store) == len(seen) == 2
    whole = compare(methods, SPIRAL, store=file, **QUICK)
    assert list(whole["method"].unique()) == list("123456")


def test_failures_are_tried_again(file):
    broken = {"now": True}

    def factory(dim):
        ds = FDM(dim, n_layers=5)
        if broken["now"]:
            ds.fit = lambda demonstration: 1 / 0
        return ds

    def refuse(dim):
        raise RuntimeError("cannot even be made")

    cells = [Cell("FDM", factory, SPIRAL), Cell("none", refuse, SPIRAL)]

    def status():
        outcomes = run(cells, RolloutProtocol(n_starts=1, n_points=30), n_jobs=1, store=file)
        return {outcome.method: [row["status"] for row in outcome.rows] for outcome in outcomes}

    assert status() == {"FDM": ["failed"] * 2, "none": ["failed"] * 2}
    broken["now"] = False
    assert status() == {"FDM": ["ok"] * 2, "none": ["failed"] * 2}


def test_everything_that_changes_a_result_changes_its_key():
    demonstration = Demonstration(SPIRAL.positions, SPIRAL.dt, "a")
    base = Cell("m", lambda dim: SDSEF(dim, n_layers=2, n_features=10), demonstration)
    keys = [
        _key(cell, protocol)
        for cell, protocol in [
            (base, RolloutProtocol()),
            (Cell("other", base.factory, demonstration), RolloutProtocol()),
            (Cell("m", lambda dim: SDSEF(dim, n_layers=3, n_features=10), demonstration), RolloutProtocol()),
            (
                Cell("m", lambda dim: SDSEF(dim, n_layers=2, n_features=10, recipe="official"), demonstration),
                RolloutProtocol(),
            ),
            (Cell("m", lambda dim: SDSEF(dim, n_layers=2, n_features=10, seed=1), demonstration), RolloutProtocol()),
            (Cell("m", lambda dim: FDM(dim), demonstration), RolloutProtocol()),
            (Cell("m", lambda dim: FDM(dim, beta=0.4), demonstration), RolloutProtocol()),
            (Cell("m", lambda dim: FDM(dim, mu=0.8), demonstration), RolloutProtocol()),
            (Cell("m", base.factory, Demonstration(SPIRAL.positions + 1e-15, SPIRAL.dt, "a")), RolloutProtocol()),
            (Cell("m", base.factory, Demonstration(SPIRAL.positions, 2 * SPIRAL.dt, "a")), RolloutProtocol()),
            (Cell("m", base.factory, Demonstration(SPIRAL.positions, SPIRAL.dt, "b")), RolloutProtocol()),
            (Cell("m", base.factory, demonstration, 1), RolloutProtocol()),
            (base, RolloutProtocol(n_starts=19)),
            (base, RolloutProtocol(radius=0.2)),
            (base, RolloutProtocol(n_points=400)),
        ]
    ]
    assert len(set(keys)) == len(keys)
    same = Cell("m", lambda n: SDSEF(n, n_features=10, n_layers=2), Demonstration(SPIRAL.positions, SPIRAL.dt, "a"))
    assert _key(same, RolloutProtocol()) == keys[0]


class Slots:
    __slots__ = ("a",)

    def __init__(self, a):
        self.a = a


def test_fingerprints_tell_values_apart_and_know_them_again():
    def things():
        loop = []
        loop.append(loop)
        return [
            None, True, 1, 1.0, 1 + 0j, "1", b"1", (1,), [1], {1: 2}, {2: 1}, {1, 2}, {"b", "a", "c"}, loop,
            Slots(1), Slots(2),
            torch.float32, torch.float64, torch.tensor([1.0]), torch.tensor([1.0], dtype=torch.float64), np.float64(1),
            np.zeros((2, 3)), np.zeros((3, 2)), functools.partial(int, 1), functools.partial(int, 2), len, max,
            lambda x: x + 1, lambda x: x + 2, Slots, torch.nn.Linear, np,
        ]  # fmt: skip

    hashes = [fingerprint(thing) for thing in things()]
    assert len(set(hashes)) == len(hashes)
    assert hashes == [fingerprint(thing) for thing in things()]


def closing_over(value):
    return lambda x: x + value


def nesting(power):
    """Two functions that differ in a function inside them."""
    if power == 2:
        return lambda rows: [(lambda x: x**2)(row) for row in rows]
    return lambda rows: [(lambda x: x**3)(row) for row in rows]


def looping():
    def down(n):
        return 0 if n == 0 else down(n - 1)

    return down


def test_functions_are_told_apart_by_all_that_they_compute_with():
    def functions():
        return [
            lambda x: np.mean(x), lambda x: np.max(x), lambda x: len(x), lambda x: sum(x),
            closing_over(1), closing_over(2), nesting(2), nesting(3), looping(),
            lambda x, a=1: a, lambda x, a=2: a, lambda x, *, a=1: a, lambda x, *, a=2: a,
            lambda x: x in {"a", "b", "c"}, lambda x: x in {"a", "b", "d"},
            functools.cache(closing_over(1)), functools.cache(closing_over(2)),
            numba.njit(closing_over(1)), numba.njit(closing_over(2)), numba.njit(closing_over(2), fastmath=True),
            np.log1p, np.expm1, np.linalg.norm, str.upper, str.lower, "a".join, "b".join,
        ]  # fmt: skip

    keys = [fingerprint(function) for function in functions()]
    assert len(set(keys)) == len(keys)
    assert keys == [fingerprint(function) for function in functions()]
    first, second = functions()[:2]
    assert fingerprint(first, second, first) != fingerprint(first, second, second)


class Gain:
    limit = 1.0
    shapes = [1, 2]  # noqa: RUF012

    def raised(self, x):
        return 2 * x

    @property
    def doubled(self):
        return self.raised(self.limit)

    @functools.cached_property
    def once(self):
        return self.limit

    @staticmethod
    def fixed(x):
        return x + 1


class Inherits(Gain):
    pass


@pytest.mark.parametrize(
    "change",
    [
        {"limit": 2.0},
        {"shapes": [1, 3]},
        {"raised": lambda self, x: 3 * x},
        {"doubled": property(lambda self: 7)},
        {"once": functools.cached_property(lambda self: 7)},
        {"fixed": staticmethod(lambda x: x + 2)},
        {"more": 1},
    ],
    ids=lambda change: next(iter(change)),
)
def test_a_changed_class_changes_the_key_of_what_is_made_of_it(monkeypatch, change):
    before = fingerprint(Inherits()), fingerprint(Inherits)
    assert before == (fingerprint(Inherits()), fingerprint(Inherits))
    for name, value in change.items():
        monkeypatch.setattr(Gain, name, value, raising=False)
    assert fingerprint(Inherits()) != before[0]
    assert fingerprint(Inherits) != before[1]


def test_what_torch_does_to_its_own_classes_is_not_the_methods(monkeypatch):
    """As torch.export does once it is used: the cells of a session would be forgotten."""
    before, made = fingerprint(FDM), torch.nn.Module.__init__

    def patched(self, *args, **kwargs):
        made(self, *args, **kwargs)

    monkeypatch.setattr(torch.nn.Module, "__init__", patched)
    assert fingerprint(FDM) == before


def counted(thing):
    """The modules whose files are in a thing's key."""
    pickler = cache._KeyPickler({"latentds.cell"})
    pickler.dump(thing)
    return {name for name, _ in cache._sources(pickler.modules)[0]}


def test_files_that_a_fit_can_reach_count_and_no_others():
    common, theirs = counted(1), counted(SDSEF(2))
    assert {"latentds.cell", "latentds.base", "latentds.metrics", "latentds.kernels.velocity"} < common < theirs
    assert {"baselines.sdsef", "baselines.couplings"} < theirs
    assert not theirs & {"baselines.dmp", "baselines.fdm", "baselines"}
    assert {"latentds.methods.tube", "latentds.fitting.homotopy"} < counted(TubeDS(2))
    assert "latentds.certificate" in counted(report.findings)
    assert "latentds.report" not in counted(report.findings)
    for apart in ("latentds.cli", "latentds.plotting", "latentds.report", "latentds.testing"):
        assert not [name for name in counted(TubeDS(2)) if name.startswith(apart)]


TOOL = """
import functools
import numba

class Tool:
    def used(self): return 1
    @property
    def width(self): return 1
    @staticmethod
    def fixed(): return 1

@numba.njit
def compiled(x): return x

@functools.cache
def remembering(x): return x
"""


@pytest.fixture
def their_package(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "theirs" / "inner").mkdir(parents=True)
    files = {
        "theirs/__init__.py": "", "theirs/helper.py": "RATE = 1.0", "theirs/other.py": "", "theirs/lazy.py": "",
        "theirs/inner/__init__.py": "from . import deep", "theirs/inner/deep.py": "WIDTHS = (1, 2)",
        "theirs/method.py": "from . import helper\nfrom .inner import deep\nclass Method: pass\n"
        "def function():\n    from theirs import lazy\n",
        "tools.py": "", "alone.py": "def helper(x): return helped * x\nhelped = 1\nclass Alone: pass\n" + TOOL,
        "calling.py": "from alone import helper\nimport tools as tools\ndef calls(x): return helper(x)\n",
    }  # fmt: skip
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    yield tmp_path
    for name in [name for name in sys.modules if name.partition(".")[0] in ("theirs", "alone", "calling", "tools")]:
        del sys.modules[name]


def test_files_of_a_methods_package_count_if_the_method_imports_them(their_package, monkeypatch):
    from alone import Alone
    from calling import calls
    from theirs.method import Method, function

    things = {"Method": Method(), "function": function, "Alone": Alone(), "calls": calls}

    def changed(edit):
        before = {label: fingerprint(thing) for label, thing in things.items()}
        edit()
        return {label for label, thing in things.items() if fingerprint(thing) != before[label]}

    def edited(name):
        with (their_package / name).open("a") as file:
            return changed(lambda: print("# changed", file=file, flush=True))

    assert edited("theirs/helper.py") == {"Method", "function"}
    assert edited("theirs/inner/deep.py") == {"Method", "function"}
    assert edited("theirs/lazy.py") == {"Method", "function"}  # imported in a function, and not yet
    assert edited("theirs/other.py") == set()
    assert edited("alone.py") == {"Alone", "calls"}
    import theirs.helper
    import theirs.inner.deep
    import theirs.lazy

    assert changed(lambda: monkeypatch.setattr(theirs.helper, "RATE", 2.0)) == {"Method", "function"}
    assert changed(lambda: monkeypatch.setattr(theirs.inner.deep, "WIDTHS", [1, 2])) == {"Method", "function"}
    assert changed(lambda: monkeypatch.setattr("alone.helped", 2)) == {"Alone", "calls"}


REPLACEMENTS = {
    "a function": ("alone.helper", lambda x: 7),
    "a function that others import by name": ("calling.helper", lambda x: 7),
    "a function by a callable": ("alone.helper", functools.partial(max, 7)),
    "a method": ("alone.Tool.used", lambda self: 7),
    "a property": ("alone.Tool.width", property(lambda self: 7)),
    "a static method": ("alone.Tool.fixed", staticmethod(lambda: 7)),
    "a class": ("alone.Tool", Gain),
    "an imported module": ("calling.tools", sys),
    "a compiled function": ("alone.compiled", numba.njit(closing_over(7))),
    "a function with a memory": ("alone.remembering", functools.cache(closing_over(7))),
}


@pytest.mark.parametrize("what", REPLACEMENTS)
def test_what_was_replaced_in_a_module_counts(their_package, monkeypatch, what):
    from calling import calls

    before, (place, value) = fingerprint(calls), REPLACEMENTS[what]
    with monkeypatch.context() as patched:
        patched.setattr(place, value)
        after = fingerprint(calls)
        assert after == fingerprint(calls)
    assert after != before == fingerprint(calls)


def test_what_this_library_was_made_to_do_counts(monkeypatch):
    before = fingerprint(TubeDS(2))
    monkeypatch.setattr("latentds.methods.tube.refuse_crossings", lambda *_: None)
    assert fingerprint(TubeDS(2)) != before


def test_an_edit_after_the_import_gives_a_key_of_its_own_until_all_is_loaded_anew(their_package):
    import alone
    import calling

    before = fingerprint(calling.calls)
    text = (their_package / "alone.py").read_text()
    (their_package / "alone.py").write_text(text.replace("helped * x", "helped * x * 2"))
    old_code = fingerprint(calling.calls)
    importlib.reload(alone)
    old_import = fingerprint(calling.calls)
    importlib.reload(calling)
    new = fingerprint(calling.calls)
    assert len({before, old_code, old_import, new}) == 4
    code = "import calling; from latentds.cache import fingerprint; print(fingerprint(calling.calls))"
    paths = os.pathsep.join([str(their_package), os.getcwd()])
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, "PYTHONPATH": paths},
    )
    assert done.stdout.strip() == new


def test_a_constant_of_this_library_that_was_changed_counts_for_all(monkeypatch):
    things = (1.5, ChebyshevDS(2, n_layers=2), FDM(2, n_layers=2))
    before = [fingerprint(thing) for thing in things]
    monkeypatch.setattr("latentds.cell.CONVERGED_WITHIN", 0.5)
    assert all(was != fingerprint(thing) for was, thing in zip(before, things, strict=True))


def test_running_changes_no_key():
    """What a run fills and loads on its way, caches and lazy imports, is no part of the settings."""

    def keys():
        return [fingerprint(TubeDS(3)), fingerprint(SDSEF(3, n_layers=2, n_features=10, seed=1)), fingerprint(FDM(3))]

    before = keys()
    methods = {"TubeDS": lambda dim: TubeDS(dim, n_layers=10, refined=False), "FDM": lambda dim: FDM(dim, n_layers=5)}
    compare(methods, SPIRAL, **QUICK)
    assert keys() == before


def test_frozen_and_tied_parameters_count():
    def layers(change=lambda module: None):
        torch.manual_seed(0)
        module = torch.nn.Sequential(torch.nn.Linear(2, 2), torch.nn.Linear(2, 2))
        module[1].load_state_dict(module[0].state_dict())
        change(module)
        return fingerprint(module)

    def tie(module):
        module[1].weight = module[0].weight

    assert layers() == layers()
    assert len({layers(), layers(lambda module: module[0].requires_grad_(False)), layers(tie)}) == 3


class Config(dict):
    def __init__(self, rate):
        self.rate = rate


def test_unusual_buffers_and_names_can_be_read():
    masked = [np.ma.masked_array([1.0, 2.0], mask) for mask in ([True, False], [False, True])]
    plain = torch.eye(3)
    things = [
        plain,
        plain.to(torch.bfloat16),
        plain.to_sparse(),
        plain.clone().requires_grad_(),
        "\ud800",
        2**63,
        *masked,
        Config(1e-2),
        Config(1e-3),
        {},
    ]
    assert len({fingerprint(thing) for thing in things}) == len(things)


@pytest.mark.parametrize("hidden", [threading.Lock(), (i for i in ()), np.frompyfunc(lambda x: x, 1, 1), sys.stdout])
def test_what_cannot_be_read_has_no_key(hidden):
    with pytest.raises(UnreadableError, match=r"expected .* got"):
        fingerprint({"a": [hidden]})


PRINTS = """
import functools, numba, numpy as np, torch
from baselines import FDM, SDSEF
from latentds.cache import fingerprint

SCALE = {"b": 2.0, "a": {"x", "y", "z"}}

def helper(x):
    return x * SCALE["b"] in {"p", "q", "r"}

@numba.njit
def jitted(x):
    return x + 1

class Mine(FDM):
    kinds = frozenset("stu")

    @functools.cached_property
    def cached(self):
        return jitted(2)

    def forward(self, y):
        return super().forward(helper(y))

torch.manual_seed(0)
for thing in (SDSEF(3, n_layers=2, n_features=10), {"b", "a", "c"}, Mine(3), lambda x: x in {"p", "q"}, helper, jitted):
    print(fingerprint(thing))
"""


@pytest.mark.slow
def test_fingerprints_do_not_depend_on_the_process():
    found = {
        subprocess.run(
            [sys.executable, *arguments],
            input=PRINTS,
            capture_output=True,
            text=True,
            check=True,
            env={**os.environ, "PYTHONHASHSEED": seed},
        ).stdout
        for seed, arguments in {"1": ["-"], "2": ["-c", PRINTS]}.items()
    }
    assert len(found) == 1
    assert len(set(found.pop().split())) == 6


def test_a_file_of_another_kind_is_refused(file):
    file.write_text("rows\n" * 1000)
    with pytest.raises(ValueError, match=r"^store: expected a file of finished cells"):
        compare({"FDM": FDM}, SPIRAL, store=file, **QUICK)
    assert file.read_text() == "rows\n" * 1000
    file.unlink()
    with sqlite3.connect(file) as other:
        other.execute("CREATE TABLE theirs (x)")
    with pytest.raises(ValueError, match=r"^store: expected a file of finished cells"):
        CellStore(file)
    with pytest.raises(ValueError, match=r"^store: expected a file of finished cells"):
        CellStore(file.parent / "nowhere" / "cells.sqlite")


TYPED = """
import sys
import torch
from latentds import compare, datasets, Learned, StableDS

RATE = {rate}

def decay(y):
    return -RATE * y

class Typed(StableDS):
    power = {power}

    def _learn(self, shown, progress):
        print("fitted")
        self.attractor.copy_(shown[0].goal)
        return Learned(0.0)

    def forward(self, y):
        return decay(y - self.attractor)

    def lyapunov(self, y):
        return (y - self.attractor).square().sum(-1) ** self.power

    def rollout(self, y0, t):
        left = torch.exp(decay(t - t[0]))[:, None]
        return self.attractor + {factor} * left * (y0 - self.attractor).unsqueeze(-2)

shown = datasets.unstable_spiral(1, 60)
rows = compare({{"typed": Typed}}, shown, n_starts=0, n_points=30, n_jobs=1, store=sys.argv[1])
print(float(rows["dtw"][0]))
"""


@pytest.mark.slow
def test_a_method_that_was_typed_in_is_computed_anew_when_it_changes(file):
    def typed(seed="0", **changes):
        done = subprocess.run(
            [sys.executable, "-", file],
            input=TYPED.format(**{"rate": 1.0, "power": 1, "factor": 1} | changes),
            capture_output=True,
            text=True,
            env={**os.environ, "PYTHONHASHSEED": seed},
        )
        assert not done.returncode, done.stderr
        return done.stdout.split()

    first = typed()
    assert typed("1") == first[1:]  # known again
    changes = ({"rate": 2.0}, {"factor": 1.5}, {"power": 2})  # a global that a helper names, a constant, an attribute
    assert [typed(**change)[0] for change in changes] == ["fitted"] * 3
    assert typed(rate=2.0)[0] != first[1]


class Locked(FDM):
    """Holds what no key can stand for."""

    def __init__(self, dim):
        super().__init__(dim, n_layers=5)
        self.lock = threading.Lock()


def test_a_method_that_cannot_be_read_is_not_kept_and_told(file):
    methods = {"locked": Locked, "FDM": counting([])}
    shown = [SPIRAL, datasets.archimedean_spiral(40)]
    for _ in range(2):
        with pytest.warns(RuntimeWarning, match=r"^store: 'locked' is not kept but .*: expected .* got .*lock") as told:
            rows = compare(methods, shown, store=file, **QUICK)
        assert len(told) == 1
        assert (rows["status"] == "ok").all()
        with CellStore(file) as cells:
            assert len(cells) == 2  # FDM's


@pytest.mark.parametrize("make", [os.mkfifo, os.mkdir, lambda path: os.symlink("/dev/zero", path)])
def test_what_is_no_file_is_refused(file, make):
    make(file)
    with pytest.raises(ValueError, match=r"^store: expected a file of finished cells, got .*regular file"):
        CellStore(file)


def test_a_damaged_store_gives_what_it_got_or_one_clear_error(file, tmp_path):
    draw = np.random.default_rng(0)
    kept = {f"key {i}": ({"method": "m", "demonstration": "d", "seed": i, "dtw": i / 3},) for i in range(40)}
    paths = draw.standard_normal((3, 100, 3))
    with CellStore(file) as cells:
        for key, rows in kept.items():
            cells.put(key, rows, paths)
    whole, refused = file.read_bytes(), []
    for place in [*draw.integers(0, len(whole), 60), 0, 20, 100, len(whole) - 1]:
        damaged = tmp_path / "damaged"
        damaged.write_bytes(whole[:place] + draw.bytes(min(500, len(whole) - place)) + whole[place + 500 :])
        try:
            with CellStore(damaged) as cells:
                for key in kept.keys() & cells.keys():
                    if (found := cells.get(key)) is not None:
                        assert found[0] == kept[key]
                        assert np.array_equal(found[1], paths)
        except ValueError as error:
            refused.append(str(error))
    assert len(refused) > 10
    assert all(text.startswith(f"store: expected a file of finished cells, got {damaged} (") for text in refused)
    (tmp_path / "half").write_bytes(whole[: len(whole) // 2])
    with (
        pytest.raises(ValueError, match=r"^store: expected a file of finished cells"),
        CellStore(tmp_path / "half") as cells,
    ):
        assert [cells.get(key) for key in kept]


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "killpg"), reason="needs process groups")
def test_killed_runs_lose_nothing():
    kill.main(kills=3, seed=1, n_seeds=8)


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "killpg"), reason="needs process groups")
def test_ctrl_c_ends_with_what_is_done(file):
    code = f"""
from experiments import kill
try: kill.work({str(file)!r}, 2, 60)
except KeyboardInterrupt: print("interrupted", flush=True)
else: print("ran to its end", flush=True)"""
    # A shell's background jobs ignore SIGINT, and their children with them; a terminal's do not.
    child = subprocess.Popen(
        [sys.executable, "-c", code],
        start_new_session=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    kill._wait_for_more_than(3, file, child)
    os.killpg(child.pid, signal.SIGINT)  # as a terminal does
    began = time.monotonic()
    out, err = child.communicate(timeout=60)
    assert out == b"interrupted\n", (child.returncode, err)
    idle = err.count(b"Process LokyProcess")  # joblib's own workers between two cells may tell where they were hit
    assert err.count(b"Traceback") == idle, err
    assert time.monotonic() - began < 30
    with CellStore(file) as store:
        assert 3 < len(store) < len(kill.cells(60))


def test_a_store_takes_no_pickles(file):
    row = {"method": "a", "demonstration": "b", "seed": 0}
    with CellStore(file) as store, pytest.raises(ValueError, match="Object arrays cannot be saved"):
        store.put("key", (row,), np.array([None]))
