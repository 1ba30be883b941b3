"""The arm's study: two seconds of forces at the tool, what its figures mean, and the page that it writes."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

pytest.importorskip("mujoco")

from experiments.robot import page, runs
from experiments.robot.__main__ import main
from experiments.robot.arm import DOWN, HOME, Arm, Record, archimedean, kinesthetic, simulate
from latentds import TubeDS


@pytest.fixture(scope="module")
def shown():
    return archimedean(n_points=300, seconds=8.0)


@pytest.fixture(scope="module")
def field(shown):
    return TubeDS(3).fit(shown).controller()


def test_two_seconds_of_forces_keep_the_tool_on_the_curve_and_its_orientation(shown, field):
    arm, curve = Arm(), shown.positions.numpy()
    tool = runs.PassiveTool(arm, field)
    record = simulate(arm, arm.inverse(curve[0], DOWN, HOME), tool, 2.0, None, runs.DT)
    assert runs.gaps(record.tool, curve).max() < 0.008
    assert np.linalg.norm(record.tool[-1] - curve[0]) > 0.03  # it went somewhere
    turned = arm.forward(record.q[-1])[1]
    assert np.arccos(np.clip((np.trace(DOWN.T @ turned) - 1) / 2, -1, 1)) < 0.05
    assert 0 < tool.least < runs.ENERGY
    assert record.hardest < 1


def test_a_push_moves_the_tool_which_yields_and_comes_back(shown, field):
    arm, curve = Arm(), shown.positions.numpy()
    begin = arm.inverse(curve[0], DOWN, HOME)

    def off(disturb):
        return runs.gaps(simulate(arm, begin, runs.PassiveTool(arm, field), 2.0, disturb, runs.DT).tool, curve)

    pushed = off(lambda t: np.array([0.0, 0.0, runs.PUSH]) if 0.5 <= t < 0.7 else None)
    assert pushed.max() > 1.5 * off(None).max()
    assert pushed[-1] < 0.5 * pushed.max()


def record(path):
    path = np.array(path, float)
    zero = np.zeros((len(path), 7))
    return Record(np.arange(len(path)) * 0.1, zero, zero, zero, path, 0.5, 0.5)


def test_arrival_is_when_it_stays():
    path = [[1.0, 0, 0], [0, 0, 0], [0.5, 0, 0], [0.01, 0, 0], [0, 0, 0]]
    assert runs.arrival(record(path), np.array(path), np.zeros(3), 1.0) == pytest.approx(0.3)
    assert runs.arrival(record(path[:3]), np.array(path[:3]), np.zeros(3), 1.0) == math.inf


def test_time_back_is_since_the_push():
    off = np.array([0, 0, 0.5, 0.1, 0.001, 0.0])
    assert runs.time_back(record(np.zeros((6, 3))), off, 0.2, 1.0) == pytest.approx(0.2)
    assert runs.time_back(record(np.zeros((6, 3))), np.zeros(6), 0.2, 1.0) == 0
    assert runs.time_back(record(np.zeros((4, 3))), off[:4], 0.2, 1.0) == math.inf


def test_scores_do_not_count_where_a_robot_waits():
    curve = np.column_stack([np.linspace(0, 1, 200), np.zeros(200)])
    waiting = np.vstack([curve[:100], np.repeat(curve[99:100], 300, 0), curve[100:]])
    assert runs.scores(waiting, curve)["exact"] < 1e-9
    lifted = runs.scores(curve + np.array([0, 0.1]), curve)
    assert lifted["exact"] == pytest.approx(0.1)
    assert lifted["fast"] == pytest.approx(0.1 * runs.N_POINTS)


def test_recordings_beyond_the_limits_are_refused(shown):
    wide = replace(kinesthetic(Arm(), 0, n_points=40), name="mine")
    wide = replace(wide, positions=wide.positions * 10)
    with pytest.raises(ValueError, match="data: expected angles within the arm's limits, rad, got mine with joint"):
        runs.of_joints(TubeDS(7), wide)


def test_the_page_tells_each_figure_and_draws(tmp_path, shown):
    arm = Arm()
    guided = kinesthetic(arm, 0, n_points=40)
    line = shown.positions.numpy()[::3].tolist()
    tool = dict.fromkeys((*page.TOOL, *page.TOUCHED), 0.5) | {"motion": shown.name, "dim": 3}
    joint = dict.fromkeys(page.JOINTS, 0.25) | {"motion": guided.name, "dim": 7}
    drawn = dict.fromkeys(("free", "pushed", "held", "moved", "around", "shown"), line)
    drawn |= {"ball": line[40], "angles": [HOME.tolist()] * len(line)}
    each = [row | {"method": method} for row in (tool, joint) for method in ("FDM", "TubeDS")]
    rows = pd.DataFrame(each).assign(drawn=json.dumps(drawn))
    rows["follows"] = rows["method"] == "TubeDS"
    rows.loc[0, "arrival"] = math.inf
    pictures = page.pictures(rows, [shown, guided], tmp_path / "images" / "robot")
    text = page.document(rows, pictures)
    assert "FDM arrives in 1 of 2 undisturbed runs" in text
    assert "TubeDS arrives in 2 of 2" in text
    assert "| kinesthetic a (paper's a: 25.92) | TubeDS | yes | 0.25 | 0.2500 |" in text
    assert text.split("## The tool")[1].split("| FDM |")[1].startswith(" **no** | 0.50 | 0.5000 | 0.5 | — |")
    assert {one.name for one in pictures} == {"paintings.png", "touched.png", "run.gif"}
    for one in pictures:
        assert one.stat().st_size > 3000
        assert f"images/robot/{one.name}" in text


def test_recordings_of_another_dimension_are_refused_before_any_work(tmp_path, shown):
    shown.save(tmp_path / "tool.csv")
    with pytest.raises(Exception, match="data: expected seven joint angles, got tool"):
        main(data=[tmp_path / "tool.csv"], out=tmp_path / "out")
    assert not (tmp_path / "out").exists()
