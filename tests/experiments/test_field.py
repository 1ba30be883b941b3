"""The field's protocols, against their definitions."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
import torch

from experiments.field import references
from experiments.field.protocols import (
    held_out_velocities,
    in_sample,
    leave_one_out,
    one_to_others,
    protocol_a,
    protocol_c,
    velocity_errors,
)
from experiments.several import PROTOCOLS, curve_rows, numbered, study, summary
from latentds import Demonstration, TubeDS
from latentds.testing import wavy_motion


def test_velocity_errors_are_as_defined():
    shown = [wavy_motion(2, seed, n_points=60) for seed in (0, 1)]
    ds = TubeDS(2)
    total, turned, count, moving = 0.0, 0.0, 0, 0
    for d in shown:
        for y, v in zip(d.positions, d.velocities.numpy(), strict=True):
            w = ds(y).detach().numpy()
            total, count = total + np.sqrt(((w - v) ** 2).mean()), count + 1
            if np.linalg.norm(v) > 0:
                turned += abs(1 - w @ v / np.linalg.norm(w) / np.linalg.norm(v))
                moving += 1
    found = velocity_errors(ds, shown)
    assert found["rmse"] == pytest.approx(total / count)
    assert found["e"] == pytest.approx(turned / moving)


def test_protocol_c_trains_on_four_and_every_second_sample():
    shape = [Demonstration(torch.rand(11, 2), 0.1, f"shape {i}") for i in range(7)]
    cell = protocol_c("any", TubeDS, shape)
    assert cell.demonstration == "shape 0 to shape 3"
    assert all(torch.equal(d.positions, whole.positions[::2]) for d, whole in zip(cell.shown, shape[:4], strict=True))
    assert [d.name for d in cell.judges] == [f"shape {i}" for i in range(4, 7)]
    assert cell.shown[1].duration == pytest.approx(shape[1].duration)


def test_the_largest_command_is_over_the_largest_speed_shown():
    shape = [wavy_motion(2, seed, n_points=60) for seed in range(7)]
    ds = TubeDS(2, n_layers=20, refined=False).fit(shape[0])
    cell = protocol_c("any", TubeDS, shape)
    commands = [float(ds(ds.rollout(d.start, d.times)).norm(dim=-1).max()) for d in cell.shown]
    fastest = max(float(d.velocities.norm(dim=-1).max()) for d in cell.shown)
    assert held_out_velocities(ds, cell)["command"] == pytest.approx(max(commands) / fastest)


def straight(*starts, n_points=11):
    """Straight motions to 0 in a second from each start in the plane."""
    way = torch.linspace(1, 0, n_points, dtype=torch.float64)[:, None]
    return [Demonstration(way * torch.tensor(y), 1 / (n_points - 1), f"line {i}") for i, y in enumerate(starts)]


def test_leave_one_out_shows_six_and_one_to_others_shows_one():
    shape = straight(*((float(i + 1), 0.0) for i in range(7)))
    names = [d.name for d in shape]
    for i in range(7):
        rest = names[:i] + names[i + 1 :]
        out, one = leave_one_out("any", TubeDS, shape, i), one_to_others("any", TubeDS, shape, i)
        assert [float(d.size) for d in out.shown] == pytest.approx([j + 1 for j in range(7) if j != i])
        assert (out.demonstration, [d.name for d in out.judges]) == (f"all but {names[i]}", [names[i]])
        assert ([d.name for d in one.shown], [d.name for d in one.judges]) == ([names[i]], rest)
    for wrong, which in ((shape, 7), (shape, -1), (shape[:1], 0)):
        with pytest.raises(ValueError, match="expected"):
            leave_one_out("any", TubeDS, wrong, which)


def test_references_are_as_worked_out_by_hand():
    """The mean of two lines along x, 2 and 4 long, is 3 long; a start beside it at x = 1.5 is one unit off."""
    shown, start = straight((2.0, 0.0), (4.0, 0.0)), torch.tensor([1.5, 1.0], dtype=torch.float64)
    times = torch.tensor([0.0, 0.25, 0.5, 2.0], dtype=torch.float64)
    assert references.plain_mean(shown, start, times) == pytest.approx(np.array([[3, 0], [2.25, 0], [1.5, 0], [0, 0]]))
    late = [[1.5, 1], [1.125, 0.75], [0.75, 0.5], [0, 0]]
    assert references.dying_offset(shown, start, times) == pytest.approx(np.array(late))
    joined = [[1.5, 1], [0.75, 0.5], [0, 0], [0, 0]]
    assert references.nearest_join(shown, start, times) == pytest.approx(np.array(joined))
    at = torch.tensor([[1.9, 5.0], [-1.0, 0.0]], dtype=torch.float64)
    assert references.nearest_velocity(shown[:1], at).numpy() == pytest.approx(np.array([[-2.0, 0], [-2, 0]]))
    for wrong in ((start[:1], times), (start, -times), (start, times[:, None])):
        with pytest.raises(ValueError, match="expected"):
            references.dying_offset(shown, *wrong)


def test_curves_are_scored_like_rollouts():
    """Beside a line, a parallel one lies as far off at each of its points as at any other."""
    shown = straight((1.0, 0.0), (1.0, 0.0), (1.0, 0.0))
    moved = Demonstration(shown[0].positions + torch.tensor([0.0, 0.5]), 0.1, "line 3")
    rows = {row["method"]: row["dtw_per_point"] for row in curve_rows(leave_one_out("any", TubeDS, [*shown, moved], 3))}
    assert rows["plain mean"] == pytest.approx(0.5)
    assert 0 < rows["dying offset"] < 0.5


def brute_force(path, reference, join):
    """The least over all monotone alignments, one by one, of what ``join`` makes of the distances of its pairs."""
    last = len(path) - 1, len(reference) - 1

    def ways(i, j):
        if (i, j) == last:
            return [[(i, j)]]
        ahead = [(i + a, j + b) for a, b in ((1, 0), (0, 1), (1, 1)) if i + a <= last[0] and j + b <= last[1]]
        return [[(i, j), *way] for step in ahead for way in ways(*step)]

    return min(join(np.linalg.norm(path[i] - reference[j]) for i, j in way) for way in ways(0, 0))


def test_protocol_a_is_as_defined():
    shape = [wavy_motion(2, seed, n_points=41) for seed in range(3)]
    ds = TubeDS(2, n_layers=20, refined=False).fit(shape[0])
    cell = protocol_a("any", TubeDS, shape)
    errors = []
    for d in shape:
        samples = d.positions[::10].numpy()
        path = ds.rollout(d.start, 10 * d.dt * torch.arange(5, dtype=torch.float64)).detach().numpy()
        rmse = np.sqrt(sum((a - b) ** 2 for a, b in zip(path.flat, samples.flat, strict=True)) / 10)
        errors.append([rmse, brute_force(path, samples, sum) / 5, brute_force(path, samples, max)])
    found = in_sample(ds, cell)
    assert all(torch.equal(a.positions, b.positions) for a, b in zip(cell.shown, shape, strict=True))
    assert [found["rmse"], found["dtwd"], found["fd"]] == pytest.approx(np.mean(errors, axis=0))


def test_a_study_names_folds_and_scores_each_by_its_own_judge():
    """Three lines along x: ProMP and curves, whose rollouts are divided by the size of the one that judges."""
    shapes = numbered({"flat line": straight((2.0, 0.0), (4.0, 0.5), (3.0, -0.5), n_points=31)})
    protocol = PROTOCOLS["leave-one-out"]
    protocol = protocol._replace(methods={"ProMP": protocol.methods["ProMP"]})
    rows = study(protocol, shapes, quick=False, jobs=1, store=None)
    assert set(rows["shape"]) == {"flat line"}
    assert len(rows) == 3 * (1 + len(references.CURVES))
    for judge, size in (("flat line 1", 2.0), ("flat line 2", 4.0), ("flat line 3", 3.0)):
        here = rows[rows["judge"] == judge]
        assert here["distance"].to_numpy() == pytest.approx(here["dtw_per_point"].to_numpy() / size)


def rows_of(figures, *scored):
    return pd.DataFrame(
        [
            {"shape": shape, "method": one, "status": "ok", **dict.fromkeys(figures, 1.0), **of}
            for shape, one, of in scored
        ]
    )


def test_the_study_of_several_tells_means_worst_and_the_best_other():
    figures = PROTOCOLS["C"].figures
    scored = [("A", "TubeDS", 2.0), ("A", "DMP", 3.0), ("B", "TubeDS", 4.0), ("B", "SEDS", 1.0)]
    text = summary("C", rows_of(figures, *((shape, one, {"test_rmse": rmse}) for shape, one, rmse in scored)))
    assert "| TubeDS | 3 (4) | 1 (1) | 1 (1) | 1 (1) | 1 (1) |" in text
    assert "| A | 2 | 1 | 1 | 1 | 1 | 3 (DMP) |" in text
    assert "| B | 4 | 1 | 1 | 1 | 1 | 1 (SEDS) |" in text
    assert "DMP learned A alone." in text


def test_the_study_names_shapes_on_which_the_plain_mean_is_nearer():
    scored = [("A", 1.05), ("A", 1.2), ("B", 1.09), ("B", 1.0)]
    rows = rows_of(["distance"], *((shape, "TubeDS", {"distance": value}) for shape, value in scored))
    mean = rows_of(["distance"], ("A", "plain mean", {}), ("B", "plain mean", {}))
    rows.loc[0, "status"] = "diverged"
    text = summary("leave-one-out", pd.concat([rows, mean]))
    assert "on: A 1.12" in text
    assert "B 1.0" not in text
    assert "TubeDS: 1 rollouts failed" in text
