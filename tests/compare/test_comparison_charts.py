"""The charts of a comparison: a picture, and a page that is opened in a browser and read back from what it draws."""

import copy
import html
import itertools
import json
import math
import re
import shutil
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import PROPERTIES

from rts import InputError
from rts.errors import PluginError
from rts_compare import chart_style
from rts_compare.html_page import write_page
from rts_compare.pareto_front import best_within, front, marked
from rts_compare.png_chart import draw

pytestmark = pytest.mark.files

NASTY = '</script><b>nasty</b> & "quoted" $x_$'


def settings(sampler="raster", engine="torch", splatter="edges", layers=2, supersample=1, rate=""):
    return dict(locals())


def row(mode, time, error, peer=None, **given):
    ms = None if time is None else {"median": time, "low": 0.9 * time, "high": 1.2 * time, "calls": 10}
    found = {"mode": mode, "settings": given if peer else settings(**given), "error": error, "gain": 1.0, "ms": ms}
    return {**found, "loss_error": 0.01, **({"peer": peer} if peer else {})}


def comparison(
    name="ball",
    modes=("translation", "color"),
    samplers=("raster", "rays"),
    engines=("torch", "jax"),
    splatters=("edges", "none"),
    layers=(1, "auto"),
    sides=(1, 2),
    rates=("", "tolerance=0.4"),
    slower=1.0,
):
    """Settings in all combinations, whose times and errors all differ, with peers and a row that was not timed."""
    rows = []
    for number, mode in enumerate(modes):
        combined = itertools.product(enumerate(samplers), engines, enumerate(splatters), layers, sides, rates)
        for count, ((a, sampler), engine, (b, splatter), k, side, rate) in enumerate(combined):
            time = slower * (5 + 3 * a) * side**2 * (1.5 if k == "auto" else 1) * 1.003**count
            error = 0.09 * (1 + number) * 4**b / side / (1.7 if k == "auto" else 1) * 1.002 ** (count % 29)
            rows.append(row(mode, time, error, **settings(sampler, engine, splatter, k, side, rate)))
        rows.append(row(mode, None, 0.001, sampler="", engine="", layers=8))
        rows.append(row(mode, 21.0, 0.25, peer="DEODR"))
        rows += [row(mode, 30.0 + spp, 0.5 / spp**0.5, peer="Mitsuba", spp=spp) for spp in (4, 16, 64)]
    return marked(
        {
            "scene": {"name": name, "note": "It moves.", "size": [48, 64]},
            "environment": {"date": "2026-01-02", "machine": NASTY, "versions": {"torch": "2.13.0"}},
            "modes": {mode: {"truth_error": 0.02} for mode in modes},
            "rows": rows,
            "left_out": ["Mitsuba, color: none", f"{NASTY}: too slow"],
        }
    )


def rows_of(compared, mode):
    return [r for r in compared["rows"] if r["mode"] == mode and r["ms"]]


# ---------------------------------------------------------------------------------------------------- the front

ROWS = st.lists(
    st.tuples(st.sampled_from("ab"), st.none() | st.integers(1, 6), st.integers(1, 6) | st.just(math.nan)), max_size=14
).map(lambda drawn: [row(*entries) for entries in drawn])


def test_the_front_of_four_rows():
    rows = [
        row("a", 1, 9.0),
        row("a", 2, 9.0),
        row("a", 3, 4.0),
        row("a", 3, 5.0),
        row("b", 7, 9.0),
        row("a", None, 0.1),
    ]
    assert front(rows) == [True, False, True, False, True, False]
    assert front([*rows, row("a", 3, 4.0)])[2:] == [True, False, True, False, True]


@PROPERTIES
@given(ROWS)
def test_no_row_is_better_than_one_on_the_front_and_one_is_better_than_each_other(rows):
    def better(r, other):
        a, b = ((x["ms"]["median"], x["error"]) for x in (r, other))
        return r["mode"] == other["mode"] and a[0] <= b[0] and a[1] <= b[1] and a != b

    known = [r for r in rows if r["ms"] and not math.isnan(r["error"])]
    expected = [any(r is k for k in known) and not any(better(k, r) for k in known) for r in rows]
    assert front(rows) == expected


@PROPERTIES
@given(ROWS, st.integers(0, 7))
def test_the_best_row_within_an_error_is_as_fast_as_any(rows, error):
    within = [r for r in rows if r["ms"] and r["error"] <= error]
    found = best_within(rows, error)
    if not within:
        assert found is None
    else:
        assert found in within
        expected = min((r["ms"]["median"], r["error"]) for r in within)
        assert (found["ms"]["median"], found["error"]) == expected


def test_marking_leaves_the_comparison_as_it_was():
    given = comparison()
    for r in given["rows"]:
        del r["front"]
    before = copy.deepcopy(given)
    found = marked(given)
    assert given == before
    assert [r["front"] for r in found["rows"]] == front(given["rows"]) and any(front(given["rows"]))


# ------------------------------------------------------------------------------------------------ looks and names


def test_settings_are_named_in_short_and_as_arguments():
    ours = row("a", 1, 1.0, layers="auto", supersample=2, rate="tolerance=0.4")
    assert chart_style.label(ours) == "edges K=auto 2×2 raster torch tolerance=0.4"
    text = chart_style.arguments(ours)
    assert text == 'sampler="raster", splatter="edges", layers="auto", supersample=2  # torch, tolerance=0.4'
    assert eval(f"dict({text}\n)") == {"sampler": "raster", "splatter": "edges", "layers": "auto", "supersample": 2}
    peer = row("a", 1, 1.0, peer="Mitsuba", spp=16)
    assert (chart_style.label(peer), chart_style.arguments(peer)) == ("Mitsuba spp=16", "# Mitsuba, spp=16")


def test_charts_name_the_versions_of_other_packages_that_are_installed():
    versions = {"rasterize-then-splat": "0.1.0", "torch": "2.13.0", "jax": None, "numpy": "2.4.6"}
    line = chart_style.environment_line({"date": "2026-01-02", "machine": "2 cores", "versions": versions})
    assert line == "2026-01-02; 2 cores; torch 2.13.0, numpy 2.4.6"


def test_built_in_names_keep_their_looks_and_others_go_by_the_order_of_their_names():
    others = [f"toy{i}" for i in range(9)]
    rows = [row("a", 1, 1.0, splatter=s, sampler=s, engine=s) for s in ("edges", *reversed(others))]
    looks = chart_style.Looks.of([*rows, row("a", 1, 1.0, peer="DEODR"), row("a", 1, 1.0)])
    assert looks.splatters["edges"] == chart_style.SPLATTER_COLORS["edges"] and looks.samplers["raster"] == "circle"
    assert [looks.splatters[name] for name in others] == [chart_style.OTHER_COLORS[i % 4] for i in range(9)]
    assert looks.engines["torch"] == "" and looks.peers == {"DEODR": chart_style.PEER_COLORS["DEODR"]}


# ---------------------------------------------------------------------------------------------------- the picture


def pixels(path):
    from PIL import Image

    return np.asarray(Image.open(path).convert("RGB"))


def shows(image, color):
    return (np.abs(image.astype(int) - [int(color[i : i + 2], 16) for i in (1, 3, 5)]).max(axis=-1) < 3).sum() > 20


def test_the_picture_has_a_panel_a_mode_and_all_colours(tmp_path):
    pytest.importorskip("matplotlib")
    draw(comparison(), tmp_path / "two.png")
    two = pixels(tmp_path / "two.png")
    for color in (
        chart_style.SPLATTER_COLORS["edges"],
        chart_style.SPLATTER_COLORS["none"],
        *chart_style.PEER_COLORS.values(),
    ):
        assert shows(two, color)
    assert not shows(two, chart_style.SPLATTER_COLORS["multi"])
    draw(comparison(modes=("camera",), splatters=("multi",)), tmp_path / "one.png")
    one = pixels(tmp_path / "one.png")
    assert one.shape[1] < 0.7 * two.shape[1] and shows(one, chart_style.SPLATTER_COLORS["multi"])


def test_rows_without_time_are_not_drawn_and_others_are(tmp_path):
    pytest.importorskip("matplotlib")
    given = comparison(modes=("shape",), rates=("",), layers=(1,))
    timed = {**given, "rows": rows_of(given, "shape")}
    fewer = {**given, "rows": [r for r in timed["rows"] if r["settings"].get("spp") != 16]}
    images = []
    for index, each in enumerate((given, timed, fewer)):
        draw(each, tmp_path / f"{index}.png")
        images.append(pixels(tmp_path / f"{index}.png"))
    assert np.array_equal(images[0], images[1])
    assert not np.array_equal(images[1], images[2])


@pytest.mark.thorough
def test_any_names_and_modes_without_rows_are_drawn(tmp_path):
    pytest.importorskip("matplotlib")
    toys = [f"{NASTY}{i}" for i in range(7)]
    given = comparison(NASTY, ("shape",), toys, ("numpy", "toy", "jax"), toys[:2], layers=(1,), rates=("",))
    given["modes"]["$camera"] = {"truth_error": math.nan}
    draw(given, tmp_path / "toys.png")
    assert pixels(tmp_path / "toys.png").std() > 1
    draw({**given, "rows": []}, tmp_path / "empty.png")


def test_what_is_missing_is_said_in_one_line(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    monkeypatch.setitem(sys.modules, "plotly.offline", None)
    with pytest.raises(PluginError, match=r"^charts need matplotlib: pip install 'rasterize-then-splat\[plots\]'$"):
        draw(comparison(), tmp_path / "a.png")
    with pytest.raises(PluginError, match=r"need plotly: pip install 'rasterize-then-splat\[plots\]'$"):
        write_page([comparison()], tmp_path / "a.html")
    assert not list(tmp_path.iterdir())


def test_what_cannot_be_written_is_refused(tmp_path):
    pytest.importorskip("matplotlib")
    pytest.importorskip("plotly")
    with pytest.raises(InputError, match="cannot be written"):
        draw(comparison(modes=("shape",), rates=("",)), tmp_path / "none" / "a.png")
    with pytest.raises(InputError, match="cannot be written"):
        write_page([comparison()], tmp_path / "none" / "a.html")
    with pytest.raises(InputError, match="no comparison"):
        write_page([], tmp_path / "a.html")


# ------------------------------------------------------------------------------------------------------- the page

READ = """
<script>
const wait = time => new Promise(done => setTimeout(done, time));
const chart = document.getElementById("chart");
const menu = async (id, text) => {
  const select = document.getElementById(id);
  select.value = [...select.options].find(option => option.text === text).value;
  select.dispatchEvent(new Event("change"));
  await wait(50);
};
const trace = name => chart.data.find(found => found.name === name);
const numbers = name => ({x: trace(name)?.x, y: trace(name)?.y});
const place = path => { const at = path.getScreenCTM(); return [at.e, at.f]; };
const middle = text => {
  const box = text.getBoundingClientRect();
  return [text.textContent, (box.left + box.right) / 2, (box.top + box.bottom) / 2];
};
const all = query => [...chart.querySelectorAll(query)];
const read = () => ({
  hash: location.hash, scene: document.getElementById("scene").selectedOptions[0].text,
  mode: document.getElementById("mode").value, settings: numbers("settings"), front: numbers("Pareto front"),
  truth: numbers("error of the truth"), Mitsuba: numbers("Mitsuba"), DEODR: numbers("DEODR"),
  drawn: all(".scatterlayer .trace path.point").map(place),
  xticks: all(".xtick text").map(middle), yticks: all(".ytick text").map(middle),
  legend: all(".legendtext").map(text => text.textContent),
  marker: trace("settings").marker,
  table: [...document.querySelectorAll("#fastest tr")].map(line => [...line.cells].map(found => found.textContent)),
  left: [...document.querySelectorAll("#left_out li")].map(item => item.textContent),
});
const event = (kind, at, target) => target.dispatchEvent(new MouseEvent(kind, {
  bubbles: true, cancelable: true, view: window, clientX: at[0], clientY: at[1], button: 0, detail: 1}));
async function drive() {
  %s
}
drive().catch(error => ({error: String(error.stack)})).then(found => {
  const written = document.createElement("pre");
  written.id = "read";
  written.textContent = JSON.stringify(found);
  document.body.append(written);
});
</script>
"""


@pytest.fixture(scope="module")
def browse(tmp_path_factory):
    """Open a page in a browser and return what a script finds there."""
    pytest.importorskip("plotly")
    names = ("chromium", "chromium-browser", "google-chrome")
    program = next(filter(None, map(shutil.which, names)), None)
    if program is None:
        pytest.skip(f"no browser on PATH; expected {', '.join(names)} (Debian's package chromium)")
    folder = tmp_path_factory.mktemp("pages")

    def call(comparisons, script, address=""):
        write_page(comparisons, folder / "page.html")
        with (folder / "page.html").open("a", encoding="utf-8") as page:
            page.write(READ % script)
        flags = ["--headless", "--no-sandbox", "--disable-gpu", "--window-size=1300,950", "--virtual-time-budget=8000"]
        done = subprocess.run(
            [program, *flags, f"--user-data-dir={folder}/profile", "--dump-dom", f"file://{folder}/page.html{address}"],
            capture_output=True,
            text=True,
            timeout=120,
        )
        found = re.search('<pre id="read">(.*?)</pre>', done.stdout, re.DOTALL)
        assert found, done.stderr[-2000:]
        read = json.loads(html.unescape(found[1]))
        assert "error" not in read, read["error"]
        return read

    return call


def sorted_pairs(x, y):
    return np.array(sorted(zip(x, y, strict=True)))


def expected_pairs(rows):
    return np.array(sorted((r["ms"]["median"], r["error"]) for r in rows))


def agrees_with(read, compared, mode):
    """Assert that a view holds the rows of a mode: in the graph's data, and in its points' places on the screen."""
    rows = rows_of(compared, mode)
    ours = [r for r in rows if "peer" not in r]
    np.testing.assert_allclose(sorted_pairs(**read["settings"]), expected_pairs(ours), rtol=1e-4)
    for peer in ("DEODR", "Mitsuba"):
        theirs = [r for r in rows if r.get("peer") == peer]
        np.testing.assert_allclose(sorted_pairs(**read[peer]), expected_pairs(theirs), rtol=1e-4)
    np.testing.assert_allclose(
        np.array([read["front"]["x"], read["front"]["y"]]).T, expected_pairs([r for r in rows if r["front"]]), rtol=1e-4
    )
    np.testing.assert_allclose(read["truth"]["y"], 0.02)
    right, down = np.array(read["drawn"]).T
    for entry, axis, places in ((1, "x", right), (2, "y", down)):
        plotted = np.concatenate([read[name][axis] for name in ("settings", "DEODR", "Mitsuba")])
        np.testing.assert_allclose(10 ** on_axis(read[f"{axis}ticks"], entry, places), plotted, rtol=0.03)


def on_axis(ticks, entry, places):
    """Logarithms of what is at some places of the screen, by where the labels of an axis are."""
    values = [float(t[0].replace(",", "").rstrip("%")) / (100 if t[0].endswith("%") else 1) for t in ticks]
    assert len(ticks) >= 2
    return np.polyval(np.polyfit([t[entry] for t in ticks], np.log10(values), 1), places)


def test_the_page_shows_what_its_menus_say(browse):
    ball = comparison()
    other = comparison(NASTY, ("camera", "shape"), splatters=("multi", NASTY), layers=(2,), slower=3.3)
    read = browse(
        [ball, other],
        """
        const first = read();
        await menu("mode", "color");
        const second = read();
        const scenes = [...document.getElementById("scene").options].map(option => option.text);
        await menu("scene", scenes[1]);
        await menu("mode", "shape");
        const third = read();
        const byRate = (await menu("by", "rate"), read());
        return {first, second, third, byRate, scenes, bold: document.querySelectorAll("b").length,
                modes: [...document.getElementById("mode").options].map(option => option.text),
                requests: performance.getEntriesByType("resource").map(entry => entry.name)};
        """,
    )
    assert read["scenes"] == ["ball", NASTY] and read["modes"] == ["camera", "shape"]
    assert read["requests"] == [] and read["bold"] == 0
    for view, compared, mode in (("first", ball, "translation"), ("second", ball, "color"), ("third", other, "shape")):
        assert (read[view]["scene"], read[view]["mode"]) == (compared["scene"]["name"], mode)
        agrees_with(read[view], compared, mode)
    assert read["second"]["hash"] == "#scene=ball&mode=color"
    others = ["other renderers", "DEODR", "Mitsuba", "lines", "Pareto front", "error of the truth"]
    for view, first in (
        ("first", ["splatter", "edges", "none"]),
        ("third", ["splatter", "multi", NASTY]),
        ("byRate", ["rate", "as given", "tolerance=0.4"]),
    ):
        shared = ["sampler", "raster", "rays", "engine", "torch", "jax", "samples a pixel", "1 × 1", "2 × 2"]
        assert read[view]["legend"] == [*first, *shared, *others]
    agrees_with(read["byRate"], other, "shape")
    by_rate, by_splatter = (set(read[view]["marker"]["color"]) for view in ("byRate", "third"))
    assert len(by_rate) == 2 and by_splatter == {chart_style.SPLATTER_COLORS["multi"], chart_style.OTHER_COLORS[0]}
    assert not by_rate & by_splatter
    assert set(read["first"]["marker"]["symbol"]) == {"circle", "circle-open", "triangle-down", "triangle-down-open"}
    by_place = dict(zip(read["first"]["settings"]["x"], read["first"]["marker"]["size"], strict=True))
    large = [r for r in rows_of(ball, "translation") if r["settings"].get("supersample") == 2]
    assert all(by_place[float(f"{r['ms']['median']:.5g}")] == chart_style.side_length(2) for r in large) and large
    assert read["first"]["left"][1] == f"{NASTY}: too slow" and len(read["first"]["left"]) == 3


@pytest.fixture(scope="module")
def used(browse):
    """A comparison, and what is read after a page of it was opened at a link, hovered over and clicked on."""
    given = comparison(modes=("shape", "color"))
    read = browse(
        [given],
        """
        const first = read(), index = 5, at = place(all(".scatterlayer .trace:first-child path.point")[index]);
        const row = {x: trace("settings").x[index], y: trace("settings").y[index]};
        const drag = chart.querySelector(".nsewdrag");
        event("mousemove", at, drag);
        await wait(300);
        const hover = all(".hoverlayer .hovertext tspan").map(text => text.textContent);
        event("mousedown", at, drag);
        event("mouseup", at, document);
        await wait(300);
        const chosen = document.getElementById("chosen").value, ring = numbers("chosen");
        document.querySelector("#fastest code").click();
        const fromTable = document.getElementById("chosen").value;
        const entry = all(".legend .traces").find(found => found.textContent === "jax").querySelector(".legendtoggle");
        event("mousedown", [0, 0], entry);
        event("mouseup", [0, 0], entry);
        await wait(1000);
        return {first, row, hover, chosen, ring, fromTable, hidden: read()};
        """,
        "#scene=ball&mode=color",
    )
    return given, read


@pytest.mark.thorough
def test_the_page_names_the_fastest_settings_within_an_error(used):
    given, read = used
    rows = rows_of(given, "color")
    ours, peers = [r for r in rows if "peer" not in r], [r for r in rows if "peer" in r]
    lines = iter(read["first"]["table"])
    for error in (0.1, 0.03, 0.01):
        title, time, least, text = next(lines)
        assert title == f"{100 * error:g} %"
        best = best_within(ours, error)
        if best is None:
            least_error = min(r["error"] for r in ours)
            assert time == "none" and text.startswith(f"the least error is {100 * least_error:.3g} %")
        else:
            assert text == chart_style.arguments(best)
            assert float(time) == pytest.approx(best["ms"]["median"], rel=1e-3)
            assert least == f"{100 * best['error']:.3g} %"
        if (peer := best_within(peers, error)) is not None:
            assert next(lines)[3] == chart_style.arguments(peer)
    assert next(lines, None) is None and any(line[1] == "none" for line in read["first"]["table"])


@pytest.mark.thorough
def test_points_are_hovered_over_clicked_on_and_hidden(used):
    given, read = used
    assert read["first"]["mode"] == "color"
    rows = rows_of(given, "color")
    (hit,) = [r for r in rows if np.allclose([r["ms"]["median"], r["error"]], list(read["row"].values()), rtol=1e-4)]
    assert read["chosen"] == chart_style.arguments(hit)
    assert read["ring"]["x"] == [read["row"]["x"]]
    hover = " ".join(read["hover"])
    for part in (*chart_style.arguments(hit).split("  "), f"error {100 * hit['error']:.3g} %", "quartiles", "10 calls"):
        assert part in hover
    assert read["fromTable"] == chart_style.arguments(best_within([r for r in rows if "peer" not in r], 0.1))
    left = [r for r in rows if r["settings"].get("engine") == "torch"]
    np.testing.assert_allclose(sorted_pairs(**read["hidden"]["settings"]), expected_pairs(left), rtol=1e-4)
    assert "jax" in read["hidden"]["legend"]


def test_fourteen_scenes_are_small_and_hold_no_markup_of_names(tmp_path):
    pytest.importorskip("plotly")
    many = comparison(NASTY, "abcde", ("raster", "rays", "embree"), layers=(1, 2, 3), sides=(1, 2, 3, 4))
    assert len(many["rows"]) >= 1450
    write_page([many] * 14, tmp_path / "page.html")
    assert (tmp_path / "page.html").stat().st_size < 8_000_000
    text = (tmp_path / "page.html").read_text()
    assert NASTY not in text and "nasty" in text
    assert "http" not in text.split('id="data"')[1]
