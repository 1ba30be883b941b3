"""The command: what it writes, what it says, and how it refuses."""

from __future__ import annotations

import csv
import importlib.metadata
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from typer.testing import CliRunner

import latentds
from latentds import ChebyshevDS, Demonstration, StableDS, cli, datasets, report
from latentds.__main__ import main
from latentds.cli import given
from latentds.testing import wavy_motion

QUICK = ["--method", "TubeDS,n_layers=100,refined=False"]
ROOT = Path(__file__).parents[1]


def run(*arguments, code=0):
    """What a command said on stdout and on stderr, after its exit code was seen to be this one."""
    done = CliRunner().invoke(cli.app, [str(argument) for argument in arguments])
    assert done.exit_code == code, done.output
    assert done.exception is None or isinstance(done.exception, SystemExit), done.exception
    return done.stdout, done.stderr


def refused(*arguments, code=1):
    """The one line with which a command refused."""
    said, told = run(*arguments, code=code)
    (line,) = told.strip().splitlines()
    assert not said
    assert line.startswith("latentds: ")
    return line


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Where commands run: with a log of an arm in milliseconds, its joints named, velocities beside them."""
    monkeypatch.chdir(tmp_path)
    motion = datasets.joint_motion(0, 150)
    rows = np.column_stack([1e3 * motion.times, motion.positions[:, :3], motion.velocities[:, :3]])
    names = ["stamp", "q_hip", "q_knee", "q_foot", "dq_hip", "dq_knee", "dq_foot"]
    np.savetxt("mine.csv", rows, delimiter=";", header=";".join(names), comments="")
    return tmp_path


@pytest.fixture(scope="module")
def system(tmp_path_factory):
    """A file with a small system that knows the names of its coordinates."""
    shown = wavy_motion(3)
    shown = Demonstration(shown.positions, shown.dt, "wavy", columns=("left", "right", "up"))
    path = tmp_path_factory.mktemp("system") / "wavy.safetensors"
    latentds.TubeDS(3, n_layers=20, refined=False).fit(shown).save(path)
    return path


def test_fit_tells_what_it_understood_and_how_it_follows(folder):
    said, told = run("fit", "mine.csv", *QUICK)
    assert told.strip() == Demonstration.load("mine.csv").origin
    ds = latentds.load("mine.safetensors")
    assert ds.settings == {**latentds.TubeDS(3).settings, "n_layers": 100, "refined": False}
    assert ds.fit_report.columns == ("q_hip", "q_knee", "q_foot")
    assert f"{ds.fit_report.fidelity.miss:.3g}" in said
    for note in ds.fit_report.notes:
        assert f"note: {note}" in said
    assert ("It follows what it was shown" in said) == (not ds.fit_report.fidelity.notes)
    assert said.splitlines()[-1] == "wrote mine.safetensors"


def test_fit_of_several_files_is_of_several_demonstrations(folder):
    (folder / "again.csv").write_bytes((folder / "mine.csv").read_bytes())
    run("fit", "mine.csv", "again.csv", "-o", "both.safetensors", "--method", "TubeDS,n_layers=150,refined=False")
    assert [name for name, _ in latentds.load("both.safetensors").fit_report.learned_from] == ["mine", "again"]


@pytest.mark.parametrize("columns", [["q_foot,q_knee,q_hip"], ["q_foot", "q_knee,q_hip"], ["3, 2,1"]])
def test_the_user_overrides_what_is_understood(folder, columns):
    options = [option for name in columns for option in ("--columns", name)]
    _, told = run("fit", "mine.csv", *options, "--dt", 0.5, *QUICK)
    ds = latentds.load("mine.safetensors")
    assert ds.fit_report.columns == ("q_foot", "q_knee", "q_hip")
    assert ds.fit_report.fidelity.shown[0].duration == pytest.approx(149 * 0.5)
    assert "positions q_foot, q_knee, q_hip;" in told


def test_a_name_of_digits_is_meant_before_a_number(folder):
    x, y = datasets.drawn("hook", 50).positions.T.numpy()
    np.savez("digits.npz", **{"t": 0.01 * np.arange(50), "2": x, "1": y})
    run("fit", "digits.npz", "--columns", "1,2", *QUICK)
    assert latentds.load("digits.safetensors").fit_report.columns == ("1", "2")


def test_time_and_unit_are_overridden(folder):
    run("fit", "mine.csv", "--time", "stamp", "--unit", "us", *QUICK)
    known = Demonstration.load("mine.csv", time="stamp", unit="us")
    assert latentds.load("mine.safetensors").fit_report.fidelity.shown[0].duration == known.duration


def test_rollout_is_the_systems_own_and_a_recording_again(folder, system):
    said, _ = run("rollout", system, "--points", 80)
    ds = latentds.load(system)
    with open("wavy-rollout.csv", newline="") as file:
        assert next(csv.reader(file)) == ["t [s]", "left", "right", "up"]
    again = Demonstration.load("wavy-rollout.csv")
    (shown,) = ds.excerpts()
    with torch.no_grad():
        wanted = ds.rollout(
            torch.tensor(shown.path[0], dtype=torch.float64), torch.linspace(0, shown.duration, 80, dtype=torch.float64)
        )
    torch.testing.assert_close(again.positions, wanted, rtol=0, atol=1e-9)
    assert again.columns == ("left", "right", "up")
    assert again.duration == pytest.approx(shown.duration)
    assert "80 rows" in said


def test_rollout_begins_and_lasts_as_asked(folder, system):
    run("rollout", system, "--from", "-0.1,0.2,0.3", "--duration", 60, "-o", "far.csv")
    far = Demonstration.load("far.csv")
    assert far.start.tolist() == [-0.1, 0.2, 0.3]
    assert far.duration == pytest.approx(60)
    torch.testing.assert_close(far.goal, latentds.load(system).attractor, atol=1e-3, rtol=0)


def test_rollout_leads_to_another_goal_and_no_faster_than_it_may(folder, system):
    ds = latentds.load(system)
    start = torch.tensor(ds.excerpts()[0].path[0], dtype=torch.float64)
    goal = ds.attractor + torch.tensor([0.1, -0.2, 0.05], dtype=torch.float64)
    asked = "--goal=" + ",".join(map(str, goal.tolist()))
    run("rollout", system, asked, "-o", "there.csv")
    there = Demonstration.load("there.csv")
    torch.testing.assert_close(there.start, start)
    with torch.no_grad():
        wanted = ds.with_start_and_goal(start, goal).rollout(start, there.times)
    torch.testing.assert_close(there.positions, wanted, rtol=0, atol=1e-9)
    fastest = float(there.velocities.norm(dim=-1).max())
    run("rollout", system, asked, "--max-speed", fastest / 2, "--duration", 60, "-o", "slow.csv")
    slow = Demonstration.load("slow.csv")
    assert float(slow.velocities.norm(dim=-1).max()) < 0.501 * fastest
    torch.testing.assert_close(slow.goal, goal, rtol=0, atol=1e-3)
    assert float(torch.cdist(slow.positions, there.positions).amin(1).max()) < 0.02 * there.size  # the same curve
    assert "max_speed: expected" in refused("rollout", system, "--max-speed", 0)
    assert "goal: expected 3 numbers" in refused("rollout", system, "--goal", "1,2")


@pytest.mark.parametrize(
    ("name", "known"),
    [("SEDS", "SEDS"), ("baselines.SDSEF", "SDSEF"), ("sds-ef", "SDSEF"), ("latentds.ChebyshevDS", "ChebyshevDS"),
     ("TubeDS", "TubeDS"), ("ProMP", "ProMP")],
)  # fmt: skip
def test_a_method_is_known_by_its_name_in_the_readme(name, known):
    assert given.method_of(name)(3).__class__.__name__ == known


def test_every_baseline_is_known_and_the_nearest_name_suggested():
    import baselines

    named = {given.method_of(name).func.__name__ for name in given.known_methods()}
    methods = {name for name, kind in vars(baselines).items() if isinstance(kind, type) and issubclass(kind, StableDS)}
    assert named == {"TubeDS", "ChebyshevDS", *methods}
    assert "did you mean ProMP?" in refused("fit", "mine.csv", "--method", "PrMP")
    assert "did you mean n_layers?" in refused("fit", "mine.csv", "--method", "TubeDS,n_layer=3")


def test_rollout_of_a_recording_fits_it_first(folder):
    run("rollout", "mine.csv", *QUICK)
    assert Demonstration.load("mine-rollout.csv").columns == ("q_hip", "q_knee", "q_foot")


@pytest.mark.parametrize(
    ("out", "begins"), [("a.png", b"\x89PNG"), ("a.svg", b"<?xml"), pytest.param("a.PDF", b"%PDF", id="capitals")]
)
def test_plot_draws_in_the_format_that_its_name_says(folder, system, out, begins):
    run("plot", system, "-o", out, "--starts", 2)
    assert (folder / out).read_bytes().startswith(begins)


@pytest.mark.parametrize("motion", [datasets.drawn("hook", 80), datasets.joint_motion(1, 80)], ids=["2-D", "7-D"])
def test_plot_draws_in_every_dimension(folder, motion):
    motion.save("a.npz")
    run("plot", "a.npz", "--starts", 1, "--method", "Chebyshev,n_layers=10")
    assert (folder / "a.png").stat().st_size > 10_000


def test_certify_says_what_certify_finds(folder, system):
    said, _ = run("certify", system, "--samples", 20, "--seed", 3, "-o", "c.json")
    found = latentds.certify(latentds.load(system), n_samples=20, seed=3)
    assert str(found) in said
    assert json.loads((folder / "c.json").read_text()) == json.loads(found.to_json())


def test_certify_exits_with_1_if_something_is_false(folder, system):
    ds = latentds.load(system)
    with torch.no_grad():
        next(ds.diffeomorphism.parameters()).mul_(1.2)  # it no longer follows what it was shown
    ds.save("edited.safetensors")
    said, _ = run("certify", "edited.safetensors", "--samples", 20, code=1)
    assert "falsified" in said.replace("not falsified", "")


def test_export_writes_what_the_exporters_write(folder, system):
    run("export", "c", system, "-o", "7-wavy.h")
    assert "field_7_wavy_velocity(" in (folder / "7-wavy.h").read_text()
    run("export", "c", system, "--name", "reach")
    assert "reach_velocity(" in (folder / "wavy.h").read_text()
    onnxruntime = pytest.importorskip("onnxruntime")
    run("export", "onnx", system)
    (velocity,) = onnxruntime.InferenceSession("wavy.onnx").run(None, {"y": np.ones((1, 3))})
    with torch.no_grad():
        np.testing.assert_allclose(velocity[0], latentds.load(system)(torch.ones(3, dtype=torch.float64)), rtol=1e-9)


@pytest.mark.slow
def test_compare_tells_writes_rows_and_a_page(folder):
    datasets.drawn("hook", 60).save("hook.npz")
    methods = ["Chebyshev,n_layers=5", "Chebyshev,n_layers=30"]
    options = [option for one in methods for option in ("--method", one)]
    said, _ = run(
        "compare", "mine.csv", "hook.npz", *options, "--starts", 2, "--jobs", 1, "-o", "all.csv", "--report", "all.html"
    )
    rows = pd.read_csv("all.csv")
    assert rows.groupby(["method", "demonstration"]).size().to_dict() == dict.fromkeys(
        [(method, name) for method in methods for name in ("mine", "hook")], 3
    )
    shown = [Demonstration.load(name) for name in ("mine.csv", "hook.npz")]
    for sentence in report.verdict(report.Comparison(rows, shown)):
        assert sentence in said
    page = (folder / "all.html").read_text()
    assert "q_knee" in page
    assert "n_layers 30" in page
    assert "radius 5% of the size of each motion" in page
    assert said.splitlines()[-2:] == ["wrote all.csv", "wrote all.html"]


def test_compare_offers_every_method_that_is_installed(folder, monkeypatch):
    methods = {"TubeDS": latentds.TubeDS, "two": dict}
    monkeypatch.setattr(given, "known_methods", lambda: methods)
    assert "StableDS, got 'two'" in refused("compare", "mine.csv")  # it was asked for, and is none
    assert "FDM" in run("compare", "--help")[0]


def test_compare_tells_of_a_method_that_fails(folder, monkeypatch):
    def lost(*arguments, **options):
        raise RuntimeError("lost [its] way")

    monkeypatch.setattr(latentds.TubeDS, "fit", lost)
    methods = "--method", "TubeDS", "--method", "Chebyshev,n_layers=5"
    said, told = run("compare", "mine.csv", *methods, "--starts", 0, "--jobs", 1, "--report", "a.html")
    assert (
        "note: compare: 1 of 2 rows failed, their scores are NaN: 1 of 'TubeDS', RuntimeError: lost [its] way" in told
    )
    assert "TubeDS: 1 of 1 motions fail or diverge." in said
    assert "failed" in (folder / "a.html").read_text()


@pytest.mark.slow
def test_report_of_recordings_and_of_a_system(folder, system):
    (folder / "again.csv").write_bytes((folder / "mine.csv").read_bytes())
    said, _ = run("report", "mine.csv", "again.csv", "--starts", 1, *QUICK)
    assert said.splitlines()[-1] == "wrote mine.html"
    assert "mine + again" in (folder / "mine.html").read_text()
    run("report", system, "--starts", 1)
    page = (folder / "wavy.html").read_text()
    assert "TubeDS follows wavy: it stays" in page
    assert "proven" in page
    ds = latentds.load(system)
    assert f"{ds.fit_report.seconds:.2g}</td>" in page  # of the fit, long ago
    ds.float().save("single.safetensors")
    run("report", "single.safetensors", "--starts", 1)
    assert "TubeDS follows wavy: it stays" in (folder / "single.html").read_text()
    run("fit", "mine.csv", "--method", "baselines:FDM,n_layers=9", "--anyway", code=3)
    run("report", "mine.safetensors", "--method", "baselines:FDM", "--starts", 1)
    assert "FDM" in (folder / "mine.html").read_text()


def test_a_report_that_cannot_be_is_refused_before_the_work(folder, system, monkeypatch):
    monkeypatch.setattr(latentds.TubeDS, "fit", lambda *_: pytest.fail("it began to fit"))
    assert ".html" in refused("report", "mine.csv", "-o", "a.pdf")
    assert "got a system" in refused("report", system, "--method", "TubeDS")
    assert "got a system" in refused("report", system, "--seed", 1)
    assert "folder" in refused("compare", "mine.csv", "--report", "absent/a.html")
    assert "no_such" in refused("compare", "mine.csv", "--method", "no_such")
    monkeypatch.setitem(sys.modules, "plotly.offline", None)
    monkeypatch.delitem(sys.modules, "latentds.report", raising=False)
    monkeypatch.delattr(latentds, "report", raising=False)
    assert "pip install 'latentds[cli]'" in run("report", "mine.csv", code=1)[1].splitlines()[-1]


def test_demo_writes_a_recording_that_is_understood(folder):
    said, _ = run("demo", "--seed", 3)
    shown = Demonstration.load("arm.csv")
    torch.testing.assert_close(shown.positions, datasets.joint_motion(3).positions)
    assert shown.columns == tuple(f"joint_{i}" for i in range(1, 8))
    assert "latentds fit arm.csv" in said
    assert "--out" in refused("demo")
    torch.testing.assert_close(Demonstration.load("arm.csv").positions, shown.positions)


def test_a_system_of_a_plugged_in_class_is_loaded(folder, monkeypatch):
    from baselines import FDM

    point, every = importlib.metadata.EntryPoint("FDM", "baselines:FDM", given.PLUGINS), importlib.metadata.entry_points
    plugged = {"group": given.PLUGINS}  # torch asks for its own on the way
    monkeypatch.setattr(importlib.metadata, "entry_points", lambda **of: [point] if of == plugged else every(**of))
    run("fit", "mine.csv", "--method", "FDM,n_layers=10", "--anyway", code=3)
    assert isinstance(latentds.load("mine.safetensors", classes=[FDM]), FDM)
    run("rollout", "mine.safetensors")
    run("fit", "mine.csv", "--method", "baselines:FDM,n_layers=9,beta=0.4", "--anyway", code=3)
    assert latentds.load("mine.safetensors", classes=[FDM]).settings["beta"] == 0.4


def test_what_is_asked_wrongly_is_refused_in_a_line(folder, system):
    (folder / "bad.csv").write_text("1,2\n1,2\nx,2\n")
    assert "no such file" in refused("fit", "nothing.csv")
    assert "bad.csv" in refused("fit", "bad.csv")
    assert "holds" in refused("fit", "mine.csv", "--columns", "q_elbow")
    assert "--columns (" in refused("fit", "mine.csv", "--columns", "q_elbow")
    assert "no_such" in refused("fit", "mine.csv", "--method", "no_such")
    assert "n_layers" in refused("fit", "mine.csv", "--method", "TubeDS,layers=3")
    assert "StableDS" in refused("fit", "mine.csv", "--method", "latentds:Demonstration")
    assert "absent" in refused("fit", "mine.csv", "--method", "absent:Class")
    assert "recording" in refused("fit", "mine.csv", "-o", "mine.npz")
    assert "folder" in refused("fit", "mine.csv", "-o", "absent/mine.safetensors")
    assert ".svg" in refused("plot", system, "-o", "a.bmp")
    assert "3 numbers" in refused("rollout", system, "--from", "1,2")
    assert "duration" in refused("rollout", system, "--duration", "-1")
    assert "got a system" in refused("certify", system, "--dt", "1")
    ChebyshevDS(2).save("unfitted.safetensors")
    assert "keeps no demonstration" in refused("rollout", "unfitted.safetensors")
    np.savetxt("sure.csv", np.random.default_rng(0).standard_normal((30, 3)))
    assert "--dt" in refused("fit", "sure.csv")


def test_what_was_read_is_never_written_over(folder):
    before = (folder / "mine.csv").read_bytes()
    assert "what was read" in refused("rollout", "mine.csv", "-o", "mine.csv")
    (folder / "link.csv").symlink_to("mine.csv")
    assert "what was read" in refused("rollout", "mine.csv", "-o", "link.csv")
    assert (folder / "mine.csv").read_bytes() == before


def test_a_usage_error_exits_with_2(folder):
    assert "--dt" in run("fit", "mine.csv", "--dt", "soon", code=2)[1]
    run("no-such-command", code=2)


def test_an_interrupt_says_so_and_exits_with_130(folder, monkeypatch):
    def interrupted(*arguments, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr(latentds.TubeDS, "fit", interrupted)
    _, told = run("fit", "mine.csv", code=130)
    assert told.splitlines()[-1] == "latentds: interrupted"
    assert not (folder / "mine.safetensors").exists()


def test_a_bug_of_ours_is_no_line(folder, monkeypatch):
    monkeypatch.setattr(given, "method_of", lambda text: 1 / 0)
    assert isinstance(CliRunner().invoke(cli.app, ["fit", "mine.csv"]).exception, ZeroDivisionError)


def test_every_command_has_help_with_an_example():
    names = re.findall(r"^│ ([a-z]+) ", run("--help")[0].split("Commands")[1], re.MULTILINE)
    assert {"fit", "rollout", "plot", "certify", "compare", "report", "export", "demo"} <= set(names)
    for name in names:
        assert f" latentds {name} " in run(name, "--help")[0].replace("\n", " ")


def test_without_the_extra_it_says_what_to_install(monkeypatch):
    monkeypatch.delitem(sys.modules, "latentds.cli")
    monkeypatch.delattr(latentds, "cli")
    monkeypatch.setitem(sys.modules, "typer", None)
    with pytest.raises(SystemExit, match=r"^latentds: the command needs typer: pip install 'latentds\[cli\]'$"):
        main()


@pytest.mark.slow
def test_it_runs_as_a_module_and_completes(tmp_path):
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "_LATENTDS_COMPLETE": "complete_bash"}
    environment |= {"COMP_WORDS": "latentds cert", "COMP_CWORD": "1"}
    command = [sys.executable, "-m", "latentds"]
    done = subprocess.run(command, env=environment, cwd=tmp_path, capture_output=True, text=True)
    assert done.stdout.split() == ["certify"]


def test_check_says_what_would_hurt_marks_it_and_exits_with_3(folder):
    said, _ = run("check", "mine.csv", "-o", "mine.png")
    assert said.startswith("nothing found that would hurt a fit\nwrote mine.png")
    rows = np.loadtxt("mine.csv", delimiter=";", skiprows=1)
    rows[70, 2] += np.ptp(rows[:, 2])
    np.savetxt("glitch.csv", rows[:, :4], delimiter=";", header="stamp;q_hip;q_knee;q_foot", comments="")
    said, _ = run("check", "glitch.csv", "mine.csv", "-o", "glitch.png", code=3)
    assert "demonstration 0: column q_knee" in said
    assert "at row 70" in said
    assert ".deglitched()" in said
    assert Path("glitch.png").stat().st_size > Path("mine.png").stat().st_size


def test_a_fit_that_does_not_follow_says_so_first_and_is_written_only_anyway(folder):
    few = ["--method", "TubeDS,n_layers=1,refined=False"]
    said, told = run("fit", "mine.csv", *few, code=3)
    assert "It does NOT follow what it was shown: it " in told
    assert "mine.safetensors was not written; --anyway writes it" in said
    assert not Path("mine.safetensors").exists()
    said, _ = run("fit", "mine.csv", *few, "--anyway", code=3)
    assert "wrote mine.safetensors" in said
    assert not latentds.load("mine.safetensors").fit_report.fidelity.follows


def test_one_motion_of_a_file_or_all_are_taken(folder):
    motion = datasets.joint_motion(0, 150)
    np.savez("two.npz", q=np.stack([motion.positions[:, :3], motion.positions[:, :3] + 0.01]), dt=motion.dt)
    line = refused("fit", "two.npz")
    assert line.startswith("latentds: episode: expected one motion, got 2 in two.npz")
    assert line.endswith("pass --episode, or take all of them: --episode all")
    run("rollout", "two.npz", "--episode", "1", *QUICK)
    assert np.loadtxt("two-rollout.csv", delimiter=",", skiprows=1)[0, 1:] == pytest.approx(motion.start[:3] + 0.01)
    assert "two.npz[0]: 150 rows" in run("check", "two.npz", "--episode", "all", "-o", "two.png")[1]
    with pytest.raises(FileNotFoundError):
        given.RecordingOptions(episode="1").read([Path("none.npz")])


def test_a_folder_is_no_system(folder):
    Path("bag").mkdir()
    assert "expected a file of kind" in refused("rollout", "bag")
