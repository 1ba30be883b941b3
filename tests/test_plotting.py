"""Pictures: right panels, nothing global touched, failures not hidden."""

import copy
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from baselines import FDM
from latentds import ChebyshevDS, Demonstration, TubeDS, datasets, plotting
from latentds.benchmark import compare
from latentds.testing import wavy_motion


def spread(demonstration, n=3):
    return demonstration.positions.numpy() + 0.01 * np.arange(n)[:, None, None]


def painted(figure):
    """The picture's pixels: drawing them is what fails when a label or limit is wrong."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())


@pytest.mark.parametrize("make", [lambda: datasets.unstable_spiral(3, 60), lambda: datasets.archimedean_spiral(60)])
def test_replications_has_a_panel_per_method_with_every_rollout(make):
    shown = make()
    figure = plotting.replications(shown, {"Chebyshev": spread(shown), "FDM": spread(shown, 5)})
    assert isinstance(figure, Figure)
    assert [axes.get_title() for axes in figure.axes] == ["demonstration", "Chebyshev", "FDM"]
    colors = [line.get_color() for line in figure.axes[2].get_lines()]
    assert colors.count(plotting.color_of("FDM")) == 5
    assert painted(figure).min() < 255


@pytest.mark.parametrize(
    "draw",
    [
        plotting.replications,
        plotting.joints,
        lambda shown, paths: plotting.vector_field(FDM(2), shown, *paths.values()),
    ],
    ids=["replications", "joints", "vector_field"],
)
def test_several_demonstrations_are_all_drawn(draw):
    first = datasets.drawn("hook", 60)
    shown = [first, Demonstration(1.2 * first.positions + 3, first.dt, "larger")]
    figure = draw(shown, {"FDM": spread(first)})
    drawn = [line.get_xydata() for axes in figure.axes for line in axes.get_lines()]
    for one in shown:
        ways = (one.positions, torch.stack([one.times, one.positions[:, 0]], dim=1))
        assert any(np.array_equal(line, way) for line in drawn for way in ways), one.name
    axes = figure.axes[0]
    assert axes.get_xlim()[1] > 3 or axes.get_ylim()[1] > 3
    assert painted(figure).min() < 255


def test_replications_counts_what_leaves_the_picture():
    shown = datasets.unstable_spiral(3, 60)
    paths = spread(shown)
    paths[1, 30:] *= 100
    paths[2, 30:] = np.nan
    figure = plotting.replications(shown, {"FDM": paths})
    assert figure.axes[1].get_title() == "FDM\n2 of 3 leave the picture"
    low, high = figure.axes[1].get_xlim()
    assert high - low < 2 * shown.size
    assert painted(figure).min() < 255


def test_vector_field_shows_streamlines_demonstration_and_rollouts():
    shown = datasets.archimedean_spiral(60)
    figure = plotting.vector_field(ChebyshevDS(2, n_layers=5).fit(shown), shown, spread(shown), "Chebyshev")
    (axes,) = figure.axes
    assert axes.get_aspect() == 1
    assert len(axes.collections) > 0  # the streamlines
    assert sum(line.get_color() == plotting.color_of("Chebyshev") for line in axes.get_lines()) == 4
    assert painted(figure).min() < 255


def test_dtw_bars_shows_means_of_the_perturbed_starts():
    rows = pd.DataFrame(
        [(m, d, s, v * (s + 1) if s else 1e6) for m, v in (("a", 2.0), ("b", 3.0)) for d in "xyz" for s in range(4)],
        columns=["method", "demonstration", "start", "dtw"],
    )
    figure = plotting.dtw_bars(rows)
    heights = [bar.get_height() for bar in figure.axes[0].patches]
    assert heights == pytest.approx([6.0] * 3 + [9.0] * 3)
    assert [text.get_text() for text in figure.axes[0].get_xticklabels()] == ["x", "y", "z"]
    assert painted(figure).min() < 255


def test_dtw_bars_survives_a_method_that_failed():
    class Fails(ChebyshevDS):
        def _learn(self, shown, progress):
            raise ArithmeticError("on purpose")

    shown = datasets.unstable_spiral(1, 40)
    with pytest.warns(match="on purpose"):
        rows = compare({"works": lambda d: ChebyshevDS(d, n_layers=5), "fails": Fails}, shown, n_starts=2, n_jobs=1)
    assert painted(plotting.dtw_bars(rows)).min() < 255


def test_dtw_bars_leaves_room_for_what_is_not_done():
    rows = pd.DataFrame(
        [("a", "x", 1, 2.0), ("a", "y", 1, 3.0), ("b", "y", 1, 4.0)],
        columns=["method", "demonstration", "start", "dtw"],
    )
    assert len(plotting.dtw_bars(rows).axes[0].patches) == 4


def test_joints_has_a_row_per_coordinate():
    rng = np.random.default_rng(0)
    shown = Demonstration(rng.standard_normal((40, 7)).cumsum(axis=0), 0.01, "arm")
    figure = plotting.joints(shown, {"Chebyshev": spread(shown), "FDM": spread(shown)})
    assert len(figure.axes) == 7
    assert all(len(axes.get_lines()) == 7 for axes in figure.axes)
    assert painted(figure).min() < 255


def test_a_method_has_one_colour():
    assert plotting.color_of("mine") == plotting.color_of("mine")
    assert len({plotting.color_of(label) for label in ("Chebyshev", "FDM", "SDS-EF", "Tube")}) == 4


def test_bad_input_is_named():
    flat, solid = datasets.archimedean_spiral(20), datasets.unstable_spiral(1, 20)
    seven = Demonstration(np.random.default_rng(0).standard_normal((20, 7)), 0.1)
    with pytest.raises(ValueError, match=r"^demonstration: expected 2 or 3 dimensions"):
        plotting.replications(seven, {})
    with pytest.raises(ValueError, match=r"^paths: expected"):
        plotting.replications(solid, {"FDM": spread(flat)})
    with pytest.raises(ValueError, match=r"^paths: expected"):
        plotting.joints(solid, {"FDM": spread(solid)[0]})
    with pytest.raises(ValueError, match=r"^ds: expected"):
        plotting.vector_field(ChebyshevDS(3), solid)
    with pytest.raises(ValueError, match=r"^margin: expected"):
        plotting.vector_field(ChebyshevDS(2), flat, margin=-1)
    with pytest.raises(ValueError, match=r"^rows: expected"):
        plotting.dtw_bars(pd.DataFrame())


@pytest.mark.slow
def test_the_backend_is_left_alone():
    code = "import sys, latentds.plotting; assert 'matplotlib.pyplot' not in sys.modules"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.slow
def test_the_library_needs_none_of_the_studies_packages():
    hide = "import sys; sys.modules.update(dict.fromkeys(['matplotlib', 'pandas', 'joblib', 'rich']));"
    code = f"""{hide}
import latentds
for use in (lambda: latentds.compare({{'a': latentds.ChebyshevDS}}, latentds.datasets.unstable_spiral(1, 20)),
            lambda: __import__('latentds.plotting')):
    try: use()
    except ImportError as error: assert "pip install 'latentds[studies]'" in str(error), error
    else: raise SystemExit('expected an ImportError')
"""
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_pictures_name_the_coordinates_as_the_recording_does():
    flat = replace(datasets.archimedean_spiral(40), columns=("shoulder", "cost $"))
    axes = plotting.replications(flat, {}).axes[0]
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("shoulder", r"cost \$")
    assert plotting.joints(flat, {}).axes[0].get_ylabel() == "shoulder [rad]"
    assert plotting.vector_field(ChebyshevDS(2), flat).axes[0].get_xlabel() == "shoulder"


@pytest.fixture(scope="module")
def hook():
    shown = datasets.drawn("hook", 80)
    return TubeDS(2, n_layers=60, refined=False).fit(shown), shown


def lines_of(axes):
    return [line.get_xydata() for line in axes.get_lines()]


def test_motions_takes_what_rollout_returns_in_every_dimension():
    for dim in (1, 2, 3, 7):
        shown = wavy_motion(dim, n_points=40)
        paths = torch.from_numpy(spread(shown))
        own = plotting.motions(paths, shown, times=shown.times, label="FDM")
        assert painted(own.figure).min() < 255
        curves = 3 * (1 if dim in (2, 3) else dim)
        assert [line.get_color() for line in own.get_lines()].count(plotting.color_of("FDM")) == curves
        one = plotting.motions(paths[0])
        assert len(one.get_lines()) == curves // 3
    given = Figure().add_subplot()
    assert plotting.motions(spread(wavy_motion(2)), ax=given) is given
    with pytest.raises(ValueError, match=r"paths: expected \(T, 2\) or \(B, T, 2\)"):
        plotting.motions(np.zeros((4, 5, 3)), wavy_motion(2))


def test_a_field_shows_v_and_where_motions_go(hook):
    ds, shown = hook
    axes = plotting.field(ds, shown, lyapunov=True)
    heights = axes.collections[0].norm
    corners = torch.cartesian_prod(
        *(torch.tensor(axis(), dtype=torch.float64) for axis in (axes.get_xlim, axes.get_ylim))
    )
    assert float(ds.lyapunov(corners).max().sqrt()) <= heights.vmax * 1.1
    assert painted(axes.figure).min() < 255
    with pytest.raises(ValueError, match="ds: expected a system and a demonstration in 2-D"):
        plotting.field(TubeDS(3), wavy_motion(3))


def test_an_embedding_is_progress_and_distance_from_the_line(hook):
    ds, shown = hook
    axes = plotting.embedding(ds, shown, shown.positions)
    progress, across = lines_of(axes)[-1].T
    assert progress[[0, -1]] == pytest.approx([1, 0], abs=1e-6)
    frame = ds.frame()
    offset = (ds.encode(shown.positions[40]) - frame.attractor) / frame.length
    assert across[40] ** 2 == pytest.approx(float(offset.square().sum() - (offset @ frame.axis) ** 2), abs=1e-12)


def test_a_tube_is_the_image_of_lines_beside_the_latent_one(hook):
    ds, shown = hook
    line = lines_of(plotting.tube(ds, shown, radius=0.1))[0]
    frame = ds.frame()
    offset = (ds.encode(torch.from_numpy(line)) - frame.attractor) / frame.length
    away = (offset.square().sum(-1) - (offset @ frame.axis) ** 2).sqrt()
    assert away.detach().numpy() == pytest.approx(np.full(300, 0.1), abs=1e-6)
    solid = plotting.tube(TubeDS(3, n_layers=30, refined=False).fit(wavy_motion(3)), wavy_motion(3))
    assert len(solid.get_lines()) == 13
    with pytest.raises(ValueError, match="ds: expected 2 or 3 dimensions, got 7"):
        plotting.tube(TubeDS(7), wavy_motion(7))


def test_speeds_are_those_of_the_motions():
    times = np.linspace(0, 2, 50)
    path = np.stack([3 * times, 4 * times], axis=1)
    axes = plotting.speeds(path, times)
    assert lines_of(axes)[0][:, 1] == pytest.approx(np.full(50, 5.0))
    with pytest.raises(ValueError, match=r"times: expected \(50,\)"):
        plotting.speeds(path, times[1:])


def test_pictures_take_a_float32_system_and_motions_with_gradients(hook):
    ds, shown = copy.deepcopy(hook[0]).to(torch.float32), hook[1]
    path = ds.rollout(shown.start, shown.times)
    assert path.requires_grad
    plotting.motions(path, shown)
    plotting.speeds(path, shown.times, shown)
    plotting.tube(ds, shown)
    assert np.isfinite(lines_of(plotting.embedding(ds, shown, path))[0]).all()
    with pytest.raises(ValueError, match="ds: expected a LatentDS, which has a latent space, got MovedDS"):
        plotting.embedding(ds.with_goal(shown.goal + 0.01), shown)


def test_coordinates_and_what_was_shown_have_one_clock():
    shown = wavy_motion(4, n_points=40)
    lines = lines_of(plotting.motions(shown.positions, shown))
    assert all(line[-1, 0] == pytest.approx(shown.duration) for line in lines)
    with pytest.raises(ValueError, match=r"times: expected \(40,\)"):
        plotting.motions(shown.positions, times=shown.times[1:])
