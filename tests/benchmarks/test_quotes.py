"""`eitskin bench quoted`: numbers and pictures of pages, held to results."""

import json
from pathlib import Path

import msgspec
import numpy as np
import pytest
from typer.testing import CliRunner

from eitskin.benchmarks import quote_check
from eitskin.benchmarks.quote_check import compare, differing
from eitskin.benchmarks.quotes import ROOT, Page, Spread, pages, unit_of
from eitskin.benchmarks.results import Results, write_results
from eitskin.cli.main import app
from eitskin.errors import ConfigurationError
from eitskin.provenance import Provenance

PUBLISHED = Path(quote_check.__file__).parent / "published"
TEXT = """# A page

It takes 18.6 ms on 4,311 nodes,
with an error of 2.6e-3.

| scene | ms | found |
|---|---|---|
| idle | 2.5 (9.0) | 99 % |
| bent | 2.0 (7.4) | - |

![a picture](picture.png)
"""
QUOTED = """
document = "docs/page.md"
results = "speed"
spread.time = { factor = 2.0, why = "times of one machine" }
[[quote]]
text = '''takes {18.6 = frame_ms ~ time} ms on {4,311 = nodes} nodes,
with an error of {2.6e-3 = error}'''
[[table]]
head = "| scene | ms | found |"
title = "live"
results = "live"
spread = { "ms" = "time" }
[[picture]]
file = "docs/picture.png"
results = "live"
"""
FIGURES = {"frame_ms": 30.0, "nodes": 4311.0, "error": 2.58e-3}
LIVE = {
    "live / idle / ms": 3.0,
    "live / idle / ms #2": 5.0,
    "live / idle / found": 99.4,
    "live / bent / ms": 2.0,
    "live / bent / ms #2": 7.0,
}


def page(text=QUOTED) -> Page:
    return msgspec.toml.decode(text, type=Page)


def results(name, values, quick=False):
    return Results(name, "", Provenance.now(0), 1.0, quick, values)


def draw(path, shade):
    import matplotlib.image

    matplotlib.image.imsave(path, np.full((20, 30, 3), shade))


@pytest.fixture
def checkout(tmp_path):
    """A page, its picture, and results that agree with both."""
    (tmp_path / "docs").mkdir()
    (tmp_path / "docs" / "page.md").write_text(TEXT)
    draw(tmp_path / "docs" / "picture.png", 0.5)
    write_results(results("speed", FIGURES), tmp_path / "out")
    plots = {"picture.png": lambda path: draw(path, 0.52)}
    write_results(results("live", LIVE), tmp_path / "out", plots=plots)
    return tmp_path


def verdicts(checkout, text=QUOTED):
    found = compare(checkout / "out", [page(text)], checkout)
    return {(one.key, one.written): one.verdict for one in found}


def test_what_agrees_within_its_spread_is_equal(checkout):
    found = list(compare(checkout / "out", [page()], checkout))
    assert [one.verdict for one in found] == ["equal"] * 9
    first = found[0]
    assert (first.document, first.line, first.written) == ("docs/page.md", 3, "18.6")
    assert (first.measured, first.spread) == (30.0, "times of one machine")
    assert [one.line for one in found[3:8]] == [8, 8, 8, 9, 9]
    assert found[3].key == "live / idle / ms"
    assert found[8].written == "docs/picture.png"


@pytest.mark.parametrize(
    ("figure", "value", "verdict"),
    [
        ("frame_ms", 37.3, "off"),
        ("frame_ms", 9.2, "off"),
        ("frame_ms", 9.4, "equal"),
        ("nodes", 4312.0, "equal"),
        ("nodes", 4313.0, "off"),
        ("error", 2.69e-3, "equal"),
        ("error", 2.75e-3, "off"),
    ],
)
def test_a_number_that_is_farther_away_is_off(checkout, figure, value, verdict):
    write_results(results("speed", FIGURES | {figure: value}), checkout / "out")
    found = {key: said for (key, _), said in verdicts(checkout).items()}
    assert found.pop(figure) == verdict
    assert set(found.values()) == {"equal"}


def test_a_cell_of_a_table_that_changed_is_off(checkout):
    text = (checkout / "docs" / "page.md").read_text()
    (checkout / "docs" / "page.md").write_text(text.replace("99 %", "98 %"))
    assert verdicts(checkout)["live / idle / found", "98"] == "off"


def test_figures_that_are_gone_and_results_that_are_not_there_are_said(checkout):
    write_results(results("speed", {"nodes": 4311.0}), checkout / "out")
    assert verdicts(checkout)["frame_ms", "18.6"] == "no such figure"
    (checkout / "out" / "speed" / "results.json").unlink()
    assert verdicts(checkout)["frame_ms", "18.6"] == "not measured"


def test_quick_results_are_not_for_quoting(checkout):
    plots = {"picture.png": lambda path: draw(path, 0.8)}
    write_results(results("speed", FIGURES, quick=True), checkout / "out")
    write_results(results("live", LIVE, quick=True), checkout / "out", plots=plots)
    assert set(verdicts(checkout).values()) == {"not measured"}


def test_a_picture_that_changed_is_off_and_one_not_drawn_is_not_measured(checkout):
    drawn = checkout / "out" / "live" / "picture.png"
    draw(drawn, 0.8)
    assert verdicts(checkout)["picture.png", "docs/picture.png"] == "off"
    drawn.unlink()
    assert verdicts(checkout)["picture.png", "docs/picture.png"] == "not measured"


def test_pictures_differ_by_the_share_of_their_points(tmp_path):
    import matplotlib.image

    one = np.full((10, 10, 3), 0.5)
    other = one.copy()
    other[0, :3, 1] = 1.0
    for name, image in (("a", one), ("b", other), ("c", one[:9])):
        matplotlib.image.imsave(tmp_path / f"{name}.png", image)
    assert differing(tmp_path / "a.png", tmp_path / "a.png") == 0.0
    assert differing(tmp_path / "a.png", tmp_path / "b.png") == pytest.approx(0.03)
    assert differing(tmp_path / "a.png", tmp_path / "c.png") == 1.0


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (("takes {18.6", "took {18.6"), "expected to say this once and does so 0 times"),
        (("| scene | ms |", "| scene | s |"), "has no table number 1"),
        (("{4,311 = nodes}", "{nodes = nodes}"), "does so 0 times"),
        (("~ time", "~ tide"), "no spread 'tide'; there are: time"),
    ],
)
def test_a_quote_that_does_not_stand_is_refused(checkout, wrong, message):
    with pytest.raises(ConfigurationError, match=message):
        verdicts(checkout, QUOTED.replace(*wrong))


def test_a_file_with_an_unknown_key_is_refused_by_name(tmp_path):
    (tmp_path / "page.toml").write_text('document = "a"\nquotes = 3\n')
    with pytest.raises(ConfigurationError, match=r"page\.toml.*quotes"):
        pages(tmp_path)


def test_units_of_the_last_digit():
    written = {"18.6": 0.1, "4,311": 1.0, "2.6e-3": 1e-4, "-0.05": 0.01, "1e-13": 1e-13}
    for text, unit in written.items():
        assert unit_of(text) == pytest.approx(unit)


def test_spreads_are_factors_shares_and_never_less_than_rounding():
    assert Spread("", factor=2.0).holds(10.0, 19.9, 1.0)
    assert not Spread("", factor=2.0).holds(10.0, 20.1, 1.0)
    assert Spread("", share=0.1).holds(9.1, 10.0, 0.1)
    assert not Spread("", share=0.1).holds(8.9, 10.0, 0.1)
    assert Spread("", share=0.01).holds(3.0, 3.9, 1.0)


def test_the_command_lists_what_is_off_and_ends_with_1(checkout, monkeypatch):
    monkeypatch.setattr(quote_check, "pages", lambda: [page()])
    monkeypatch.setattr(quote_check.compare, "__defaults__", (None, checkout))
    monkeypatch.setenv("COLUMNS", "200")
    command = ["bench", "quoted", "--out", str(checkout / "out")]
    good = CliRunner().invoke(app, command)
    assert good.exit_code == 0
    assert "9 equal" in good.stdout
    write_results(results("speed", FIGURES | {"frame_ms": 99.0}), checkout / "out")
    bad = CliRunner().invoke(app, command)
    assert bad.exit_code == 1
    assert "docs/page.md:3" in bad.stdout
    assert "99 off" in bad.stdout
    printed = json.loads(CliRunner().invoke(app, [*command, "--json"]).stdout)
    assert printed["counts"] == {"equal": 8, "off": 1}


def test_outside_a_checkout_there_is_nothing_to_compare(tmp_path):
    with pytest.raises(ConfigurationError, match="run this in a checkout"):
        list(compare(tmp_path, [page()], tmp_path))


# The pages of this checkout


@pytest.mark.parametrize("quoting", pages(), ids=lambda each: each.document)
def test_every_quote_stands_in_its_page_and_agrees_with_the_published_results(quoting):
    """Word for word; each figure is one of the results that were published with the page."""
    found = [one for one in compare(PUBLISHED, [quoting]) if one.line]
    assert found
    wrong = [f"{o.document}:{o.line} {o.written} {o.key}" for o in found if o.verdict != "equal"]
    assert wrong == []
    for picture in quoting.pictures():
        assert (ROOT / picture.file).is_file()
        said = Path(picture.file).name
        assert said in (ROOT / quoting.document).read_text()


def test_readme_is_held() -> None:
    quoted = [number for page in pages() for number in page.numbers()]
    assert sum(number.document == "README.md" for number in quoted) >= 60
