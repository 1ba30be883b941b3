"""The page: one file that asks for nothing, tells what the rows say, and works in a real browser."""

from __future__ import annotations

import base64
import hashlib
import json
import math
import re
import sys
from html.parser import HTMLParser

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from experiments.screenshot import browser, show
from latentds import ChebyshevDS, Demonstration, compare, datasets, report
from latentds.cell import COLUMNS
from latentds.report.comparison import Comparison
from latentds.testing import wavy_motion

HOSTILE = "</script><img src=x onerror=\"document.title='lost'\"> & 'x' {{ 7 * 7 }}" + 80 * "y"
METHODS = "TubeDS", "FDM", "SDS-EF"


def made_up(demonstrations, methods=METHODS, n_starts=4, score=lambda method, start: 0.01 * (start + 1)):
    """Rows and rollouts as ``compare`` gives them, of the demonstrations shifted by the score, which may be NaN."""
    rows, paths = [], {}
    for item in demonstrations:
        shown = [item] if isinstance(item, Demonstration) else item
        name = " + ".join(one.name for one in shown)
        for method in methods:
            batch = []
            for start in range(len(shown) * (1 + n_starts)):
                judge, off = shown[start // (1 + n_starts)], score(method, start)
                status = "ok" if math.isfinite(off) else "failed"
                rows.append(
                    dict.fromkeys(COLUMNS, 0.5)
                    | {"method": method, "demonstration": name, "seed": 0, "start": start, "status": status}
                    | {"error": "" if status == "ok" else "RuntimeError: lost", "follows": status == "ok"}
                    | {"converged": status == "ok", "dtw_per_point": off * judge.size, "endpoint_error": off}
                )
                batch.append(judge.at(np.linspace(0, judge.duration, 60)) + off)
            paths[method, name, 0] = np.stack(batch)
    return pd.DataFrame(rows), paths


class Page(HTMLParser):
    """What a page holds: tags with their attributes, scripts, texts of cells."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.scripts, self.rows, self.open, self.inside = [], [], [], "", False
        self.feed(text)
        kinds = [dict(attributes).get("type") for tag, attributes in self.tags if tag == "script"]
        self.data = json.loads(self.scripts[kinds.index("application/json")], parse_constant=pytest.fail)

    def handle_starttag(self, tag, attributes):
        self.tags.append((tag, attributes))
        self.open = tag
        if tag == "tr":
            self.rows.append([])
        elif tag in ("td", "th"):
            self.rows[-1].append("")
            self.inside = True
        elif tag == "script":
            self.scripts.append("")

    def handle_endtag(self, tag):
        self.open = ""
        self.inside &= tag not in ("td", "th")

    def handle_data(self, text):
        if self.open == "script":
            self.scripts[-1] += text
        elif self.inside:
            self.rows[-1][-1] += text.strip()

    def row(self, first):
        return next(row for row in self.rows if row and row[0] == first)


def written(folder, rows, demonstrations, **more):
    file = folder / "page.html"
    report.write(file, rows, demonstrations, **more)
    return file.read_text(encoding="utf-8")


def positions(packed, like, n, low, high):
    """What ``page.js`` unpacks: (..., T, n), NaN for a gap."""
    whole = np.frombuffer(base64.b64decode(packed), "<i2").reshape(*like, -1, n).astype(float)
    whole[whole == -32768] = np.nan
    return low + (whole + 32767) / 65534 * (np.asarray(high) - low)


@pytest.fixture(scope="module")
def seven():
    return datasets.joint_motion(0, 100)


# What it tells --------------------------------------------------------------------------------------------------------


def test_ranking_is_by_the_mean_over_starts_nobody_showed(seven):
    rows, _ = made_up([seven], score=lambda method, start: 0.01 * METHODS.index(method) + 0.001 * start)
    lines = Comparison(rows.sample(frac=1, random_state=0), seven).ranking()
    assert [line["method"] for line in lines] == list(METHODS)
    for i, line in enumerate(lines):
        others = [0.01 * i + 0.001 * start for start in (1, 2, 3, 4)]
        assert line["level"] == pytest.approx(np.mean(others))
        assert line["spread"] == pytest.approx(np.std(others, ddof=1))
        assert line["worst"] == pytest.approx(others[-1])
        assert line["own"] == pytest.approx(0.01 * i)
        assert line["arrives"] == (5, 5)


def test_ranking_of_several_motions_weighs_them_alike(seven):
    two = [seven, wavy_motion(2)]
    rows, _ = made_up(two, ["TubeDS"])
    rows.loc[rows["demonstration"] == two[1].name, "dtw_per_point"] = 0.3 * two[1].size
    (line,) = Comparison(rows, two).ranking()
    assert line["level"] == pytest.approx((np.mean([0.02, 0.03, 0.04, 0.05]) + 0.3) / 2)
    assert line["spread"] == pytest.approx(np.std([0.02, 0.03, 0.04, 0.05], ddof=1) / 2)


def test_seeds_are_no_more_starts(seven):
    rows, _ = made_up([seven], ["TubeDS"])
    again = rows.assign(seed=1, dtw_per_point=rows["dtw_per_point"] + 0.01 * seven.size)
    (line,) = Comparison(pd.concat([rows, again]), seven).ranking()
    assert line["level"] == pytest.approx(np.mean([0.02, 0.03, 0.04, 0.05]) + 0.005)
    assert line["spread"] == pytest.approx(np.std([0.02, 0.03, 0.04, 0.05], ddof=1))
    assert line["follows"] == (2, 2)


def test_a_method_that_fails_comes_last_and_is_told(seven, tmp_path):
    rows, paths = made_up([seven], score=lambda method, start: math.nan if (method, start) == ("FDM", 2) else 0.01)
    found = Comparison(rows, seven)
    assert found.ranking()[-1]["method"] == "FDM"
    assert math.isinf(found.ranking()[-1]["level"])
    assert "FDM: 1 of 5 motions fail or diverge." in report.verdict(found)
    page = Page(written(tmp_path, rows, seven, paths=paths))
    assert page.row("FDM")[1:4] == ["failed", "—", "—"]
    (motion,) = page.data["motions"]
    assert motion["scores"][1]["others"] == [1.0, None, 1.0, 1.0]
    assert motion["methods"][1]["gone"] == 1


def test_if_all_fail_no_method_is_best(seven, tmp_path):
    rows, paths = made_up([seven], score=lambda *_: math.nan)
    assert report.verdict(Comparison(rows, seven))[0].startswith("No method moves through all of arm 0")
    assert Page(written(tmp_path, rows, seven, paths=paths)).row("TubeDS")[1] == "failed"


def test_the_verdict_says_whether_chance_may_make_the_difference(seven):
    random = np.random.default_rng(0)
    for gap, sure in ((0.5, True), (1e-4, False)):
        noise = {method: 1 + 0.1 * random.standard_normal(9) for method in METHODS}
        rows, _ = made_up(
            [seven], METHODS[:2], 8, lambda method, i, n=noise, g=gap: n[method][i] + g * METHODS.index(method)
        )
        found = Comparison(rows, seven)
        best, second = (line["method"] for line in found.ranking())
        p = stats.ttest_rel(*(rows[rows["method"] == one]["dtw_per_point"][1:] for one in (best, second))).pvalue
        assert (p < 0.01) == sure
        said = report.verdict(found)[0]
        assert said.startswith(f"{best} stays nearest to arm 0")
        assert f"before {second}" in said
        assert f"p = {p:.1g}, paired t-test over the 8 starts" in said
        assert ("chance may make" in said) == (not sure)


def test_a_tie_is_told(seven):
    rows, _ = made_up([seven], METHODS[:2])
    assert report.verdict(Comparison(rows, seven))[0].endswith("before FDM with 3.5 %, the same from every start.")


def test_the_verdict_on_one_method_says_whether_it_follows_and_what_was_noted(seven):
    rows, _ = made_up([seven], ["TubeDS"])
    (said,) = report.verdict(Comparison(rows, seven))
    assert said.startswith("TubeDS follows arm 0: it stays at a mean distance of 1 %")
    noted = rows.assign(follows=False, notes="it rests on the way; it jumps", converged=rows["start"] > 1)
    said = report.verdict(Comparison(noted, seven))
    assert said[0].startswith("TubeDS does not follow arm 0 as it should: ")
    assert "Noted: it rests on the way; it jumps." in said
    assert "TubeDS: 2 of 5 motions do not arrive at the goal within 20 durations." in said


def test_a_method_that_was_not_tried_everywhere_is_no_winner(seven, tmp_path):
    two = [seven, wavy_motion(2)]
    rows, paths = made_up(two, score=lambda method, start: 0.01 if method == "FDM" else 0.1)
    rows = rows[(rows["method"] != "FDM") | (rows["demonstration"] == "arm 0")]
    found = Comparison(rows, two)
    assert found.ranking()[-1]["method"] == "FDM"
    assert "FDM was tried on 1 of 2 motions." in report.verdict(found)
    del paths["FDM", two[1].name, 0]
    page = Page(written(tmp_path, rows, two, paths=paths))
    assert page.row(two[1].name)[2] == "not tried"
    assert page.data["motions"][1]["methods"][1] is None


@pytest.mark.slow
def test_certificates_are_shown_and_what_is_false_is_said(seven, tmp_path):
    ds = ChebyshevDS(7, n_layers=5).fit(seven)
    rows, _ = made_up([seven], ["Chebyshev"])
    told = report.findings(ds, None)
    lines = json.loads(told["certificate"])["lines"]
    false = [line["claim"] for line in lines if line["verdict"] == "falsified"]
    assert false == ["follows its demonstration"]
    text = written(tmp_path, rows.assign(**told), seven)
    assert "A motion arrives if it comes to 1 % of the size from the system&#39;s goal within 20 durations." in text
    late = told["certificate"].replace("follows its demonstration", "every motion arrives within 100 durations")
    said = report.verdict(Comparison(rows.assign(certificate=late), seven))
    assert said[-1].startswith("Chebyshev: all 5 motions arrive, but not all from farther off")
    assert "Chebyshev: falsified in its certificate: follows its demonstration." in text
    page = Page(text)
    for line in lines:
        assert page.row(line["claim"])[1] == line["verdict"]


# What it holds --------------------------------------------------------------------------------------------------------


def test_it_is_one_file_that_may_ask_for_nothing(seven, tmp_path):
    rows, paths = made_up([seven])
    text = written(tmp_path, rows, seven, paths=paths)
    page = Page(text)
    assert [path.name for path in tmp_path.iterdir()] == ["page.html"]
    (allowed,) = [dict(a)["content"] for tag, a in page.tags if tag == "meta" and "http-equiv" in dict(a)]
    assert "default-src 'none'" in allowed
    run = [one for one in page.scripts if not one.startswith("{")]
    hashes = {base64.b64encode(hashlib.sha256(one.encode()).digest()).decode() for one in run}
    assert len(run) == 2
    assert hashes == set(re.findall(r"'sha256-([^']+)'", allowed))
    asked = [value for _, a in page.tags for key, value in a if key in ("src", "href", "action", "srcset", "poster")]
    assert asked == ["data:,"]
    assert "url(" not in text.split("<style>")[1].split("</style>")[0]


@pytest.mark.parametrize("n", [1, 2, 3, 7])
def test_what_it_draws_are_the_rollouts(n, tmp_path):
    shown = wavy_motion(n)
    rows, paths = made_up([shown], score=lambda method, start: 0.01 * (start + 1) if method != "FDM" else 10.0)
    (motion,) = Page(written(tmp_path, rows, shown, paths=paths)).data["motions"]
    assert (motion["dim"], motion["name"]) == (n, shown.name)
    grid = np.frombuffer(base64.b64decode(motion["grid"]), "<f4")
    step = np.subtract(motion["high"], motion["low"]) / 65534
    drawn = positions(motion["methods"][0]["paths"], [5], n, motion["low"], motion["high"])
    wanted = paths["TubeDS", shown.name, 0][:, np.round(grid * 59).astype(int)]
    assert np.abs(drawn - wanted).max() <= step.max()
    (own,) = positions(motion["shown"], [1], n, motion["low"], motion["high"])
    assert np.abs(own - shown.at(grid.astype(float) * shown.duration)).max() < 1.5 * step.max() + 1e-6 * shown.size
    away = positions(motion["methods"][1]["paths"], [5], n, motion["low"], motion["high"])
    assert np.isnan(away).all()
    assert motion["methods"][1]["gone"] == 5


def test_of_several_demonstrations_each_rollout_keeps_its_judge(tmp_path):
    first = wavy_motion(3)
    second = Demonstration(first.positions * 2, 3 * first.dt, "slower", columns=("a", "b", "c"))
    rows, paths = made_up([[first, second]], n_starts=2)
    (motion,) = Page(written(tmp_path, rows, [[first, second]], paths=paths)).data["motions"]
    assert motion["own"] == [True, False, False] * 2
    assert motion["durations"] == [first.duration] * 3 + [second.duration] * 3
    assert motion["shown_durations"] == [first.duration, second.duration]
    np.testing.assert_allclose(motion["scores"][0]["own"], [1, 4])  # percent of its own judge's size
    np.testing.assert_allclose(motion["scores"][0]["others"], [2, 3, 5, 6])


def test_large_comparisons_are_thinned_to_less_than_six_megabytes(tmp_path):
    shown = [datasets.joint_motion(seed, 1000) for seed in range(8)]
    rows, paths = made_up(shown, n_starts=20)
    paths = {key: np.repeat(batch, 8, axis=1) for key, batch in paths.items()}
    data = Page(written(tmp_path, rows, shown, paths=paths)).data
    assert (tmp_path / "page.html").stat().st_size < 6e6
    assert all(0 < motion["starts"]["drawn"] < motion["starts"]["of"] == 21 for motion in data["motions"])
    assert all(motion["own"][0] for motion in data["motions"])


def test_hostile_names_are_text(seven, tmp_path):
    shown = Demonstration(seven.positions, seven.dt, HOSTILE, columns=[f"{HOSTILE}{i}" for i in range(7)])
    rows, paths = made_up([shown], [HOSTILE, "TubeDS"])
    page = Page(written(tmp_path, rows, shown, paths=paths, settings={HOSTILE: {HOSTILE: HOSTILE}}))
    assert [tag for tag, _ in page.tags].count("script") == 3
    assert "img" not in [tag for tag, _ in page.tags]
    assert page.data["labels"][0] == page.data["motions"][0]["name"] == HOSTILE
    assert page.data["motions"][0]["columns"][6] == f"{HOSTILE}6"
    assert page.row(HOSTILE)[0] == HOSTILE


def test_it_shows_what_compare_found(tmp_path):
    shown = [datasets.drawn("hook", 60), wavy_motion(3)]
    paths = {}
    rows = compare({"small": lambda dim: ChebyshevDS(dim, n_layers=5)}, shown, n_starts=2, n_jobs=1, paths=paths)
    page = Page(written(tmp_path, rows, shown, paths=paths, settings={"n_starts": 2}))
    assert set(paths) == {("small", one.name, 0) for one in shown}
    (line,) = Comparison(rows, shown).ranking()
    shares = [report.percent(line[key]) for key in ("level", "spread", "worst", "own", "end")]
    counts = ["{} of {}".format(*line[key]) for key in ("arrives", "follows")]
    assert page.row("small")[1:] == [*shares, *counts, f"{line['seconds']:.2g}"]
    assert line["arrives"] == (rows["converged"].sum(), 6)
    assert page.row("hook")[1].startswith(report.percent(Comparison(rows, shown).by_motion()[0]["best"]))
    assert [motion["starts"] for motion in page.data["motions"]] == [{"drawn": 3, "of": 3}] * 2
    starts = positions(page.data["motions"][1]["methods"][0]["paths"], [3], 3, *(
        page.data["motions"][1][key] for key in ("low", "high")
    ))[:, 0]  # fmt: skip
    np.testing.assert_allclose(starts[0], shown[1].start, atol=1e-4)


def test_without_rollouts_it_says_how_to_keep_them(seven, tmp_path):
    rows, _ = made_up([seven])
    text = written(tmp_path, rows, seven)
    assert "compare(…, paths=paths) keeps them" in text
    assert Page(text).data["motions"][0]["methods"] == [None] * 3


def test_what_does_not_fit_is_refused_and_nothing_is_written(seven, tmp_path):
    rows, _ = made_up([seven])
    file = tmp_path / "page.html"
    for given, shown, more, message in (
        (rows.drop(columns="dtw_per_point"), seven, {}, r"rows: .*dtw_per_point"),
        (rows[:0], seven, {}, "rows: expected at least one"),
        (rows, wavy_motion(2), {}, "demonstrations: .*'arm 0'"),
        (rows, [], {}, "demonstrations: "),
        (rows.assign(judge="another"), seven, {}, "rows: expected motions judged by those"),
        (rows, seven, {"paths": {("FDM", "arm 0", 0): np.zeros((5, 60, 6))}}, r"paths: expected \(5, T, 7\)"),
        (rows, seven, {"paths": {("FDM", "arm 0", 0): np.zeros((60, 7))}}, r"paths: expected \(5, T, 7\)"),
    ):
        with pytest.raises(ValueError, match=message):
            report.write(file, given, shown, **more)
    assert not file.exists()


def test_without_plotly_it_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "plotly.offline", None)
    monkeypatch.delitem(sys.modules, "latentds.report")
    with pytest.raises(ImportError, match=r"^reports need plotly\S*: pip install 'latentds\[cli\]'$"):
        import latentds.report  # noqa: F401


# In a browser ---------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def window():
    try:
        with browser(1400, 900) as found:
            yield found
    except FileNotFoundError as error:
        pytest.skip(f"reports were not tried in a browser: {error}")


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    """Of a planar motion and one of an arm, by three methods; one has a hostile name, one fails on the arm."""
    file = tmp_path_factory.mktemp("browser") / "page.html"
    plane, arm = datasets.drawn("hook", 60), datasets.joint_motion(0, 60)
    level = {"TubeDS": 0.02, HOSTILE: 0.01, "FDM": 0.03}
    rows, paths = made_up([plane, arm], level, score=lambda method, start: level[method] * (1 + 0.1 * start))
    rows["fit_seconds"] = rows["method"].map({HOSTILE: 2.0, "TubeDS": 10.0, "FDM": 9.0})
    lost = (rows["method"] == "FDM") & (rows["demonstration"] == arm.name)
    rows.loc[lost, ["status", "error"]] = ["failed", "RuntimeError: lost"]
    rows.loc[lost, ["dtw_per_point", "endpoint_error"]] = np.nan
    paths["FDM", arm.name, 0][:] = np.nan
    report.write(file, rows, [plane, arm], paths=paths)
    return file, plane, arm


TRACES = "return document.getElementById('{}').data.map((one) => [one.name, Array.from(one.x), Array.from(one.y)])"


def traces(window, chart, name):
    """x and y of all traces of that name."""
    return [(x, y) for known, x, y in window.execute_script(TRACES.format(chart)) if known == name]


def select(window, element, value):
    """As a user does: the value, and the event that tells of it."""
    script = "arguments[0].value = arguments[1]; for (const kind of ['input', 'change'])"
    script += " arguments[0].dispatchEvent(new Event(kind, { bubbles: true }));"
    window.execute_script(script, element, value)


@pytest.mark.slow
def test_in_a_browser_it_sorts_switches_turns_and_plays(window, page):
    from selenium.webdriver.support.wait import WebDriverWait

    file, plane, arm = page
    show(window, file)
    assert window.title == "2 motions – latentds"
    column = "return [...document.querySelectorAll('#ranking tbody tr')].map((row) => row.cells[0].innerText)"
    heads = window.find_elements("css selector", "#ranking thead button")
    assert window.execute_script(column) == [HOSTILE, "TubeDS", "FDM"]
    for order in ([HOSTILE, "FDM", "TubeDS"], ["TubeDS", "FDM", HOSTILE]):
        heads[-1].click()  # seconds of a fit
        assert window.execute_script(column) == order
    heads[1].click()  # one method failed: it is last, whichever way
    assert window.execute_script(column) == [HOSTILE, "TubeDS", "FDM"]

    assert len(traces(window, "replications", "TubeDS")) == len(traces(window, "speeds", "TubeDS")) == 1
    chip = window.find_element("css selector", "[data-method='0']")
    chip.click()
    for chart in ("replications", "speeds", "joints"):
        assert not traces(window, chart, "TubeDS")
        assert traces(window, chart, "FDM")
    chip.click()
    assert traces(window, "replications", "TubeDS")

    ((x, y),) = traces(window, "replications", "demonstration")
    np.testing.assert_allclose(np.array([x, y], dtype=float)[:, 0], plane.start, atol=1e-3)
    assert not window.find_element("id", "coordinates").is_displayed()
    slider = window.find_element("id", "moment")
    select(window, slider, 500)
    assert window.find_element("id", "clock").text == f"{plane.duration / 2:.2f} s"
    ((x, y),) = traces(window, "replications", "TubeDS")
    np.testing.assert_allclose([x[-2], y[-2]], plane.at(plane.duration / 2) + 0.02, atol=0.01)
    window.find_element("id", "play").click()
    WebDriverWait(window, 30).until(lambda _: slider.get_property("value") != "500")
    select(window, slider, 250)  # which stops it
    assert window.find_element("id", "play").text == "Play"
    window.execute_async_script("requestAnimationFrame(() => requestAnimationFrame(arguments[0]))")
    assert window.find_element("id", "clock").text == f"{plane.duration / 4:.2f} s"

    select(window, window.find_element("id", "motion"), 1)
    chosen = window.find_elements("css selector", "#coordinates select")
    assert [one.get_property("value") for one in chosen] == ["0", "1", "2"]
    select(window, chosen[0], 5)
    ((x, y),) = traces(window, "replications", "demonstration")
    np.testing.assert_allclose([x[0], y[0]], arm.start[[5, 1]], atol=1e-3)
    assert window.title == "2 motions – latentds"
    check_quiet(window)


@pytest.mark.slow
@pytest.mark.parametrize("width", [420, 1400])
def test_in_a_browser_it_is_as_wide_as_the_window(window, page, width):
    size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": False}
    window.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    show(window, page[0])
    assert window.execute_script("return [innerWidth, document.documentElement.scrollWidth]") == [width, width]
    check_quiet(window)


def check_quiet(window):
    """Nothing went wrong, nothing was asked for, and no picture hides what is beneath it."""
    bottoms = "return [...document.querySelectorAll('.chart')].map((one) => one.querySelector('.svg-container')"
    bottoms += ".getBoundingClientRect().bottom - one.getBoundingClientRect().bottom)"
    assert max(window.execute_script(bottoms)) <= 1
    wrong = [told for told in window.get_log("browser") if told["level"] == "SEVERE"]
    assert not wrong
    asked = window.execute_script("return performance.getEntriesByType('resource').map((one) => one.name)")
    assert not [name for name in asked if not name.startswith(("data:", "blob:"))]
