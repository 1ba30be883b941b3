"""Motions by name and from files."""

from __future__ import annotations

import json

import numpy as np
import pytest
import typer

from experiments import compared
from latentds import Demonstration, datasets
from latentds.testing import wavy_motion


def test_spirals_have_names_that_lead_back_to_them():
    for shown in compared.spirals(quick=True):
        assert (compared.spiral(shown.name).positions == shown.positions).all()
    assert [d.name for d in compared.spirals(quick=False)] == [d.name for d in datasets.spiral_suite(3)]


def test_recordings_are_read_from_files_and_folders(tmp_path):
    assert compared.recordings([]) == []
    for name, ending in (("two", "npz"), ("one", "csv")):
        shown = wavy_motion(2)
        Demonstration(shown.positions, shown.dt, name).save(tmp_path / f"{name}.{ending}")
    assert [shown.name for shown in compared.recordings([tmp_path])] == ["one", "two"]
    assert [shown.name for shown in compared.recordings([tmp_path / "two.npz"])] == ["two"]
    with pytest.raises(typer.BadParameter, match="data: expected recordings of different names"):
        compared.recordings([tmp_path, tmp_path / "one.csv"])
    with pytest.raises(typer.BadParameter, match=r"data: expected files of kind \.csv .*\.npz.*none in .*nothing"):
        compared.recordings([tmp_path / "nothing"])
    with pytest.raises(typer.BadParameter, match="nothing"):
        compared.recordings([tmp_path / "nothing.npz"])


def test_recordings_of_every_kind_that_a_demonstration_is_read_from(tmp_path):
    shown = wavy_motion(2)
    (tmp_path / "one.JSON").write_text(json.dumps({"dt": shown.dt, "positions": shown.positions.tolist()}))
    (tmp_path / "read me.md").write_text("no recording")
    np.savetxt(tmp_path / "two.txt", np.column_stack([shown.times, shown.positions]), header="t [s] x y")
    assert [found.positions.tolist() for found in compared.recordings([tmp_path])] == 2 * [shown.positions.tolist()]
