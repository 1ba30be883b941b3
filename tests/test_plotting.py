"""Pictures: right panels, nothing global touched, failures not hidden."""

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
from latentds import ChebyshevDS, Demonstration, datasets, plotting
from latentds.benchmark import compare


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
