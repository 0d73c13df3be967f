"""Figures of pages are those of the published results."""

import pytest

from eitskin.benchmarks import page_figures
from eitskin.benchmarks.page_figures import figures_in, full_results, pages, rendered, rewritten
from eitskin.benchmarks.results import Report, Results
from eitskin.errors import ConfigurationError
from eitskin.provenance import Provenance

PUBLISHED = full_results()
PAGE = """# A page

It takes 18.6 ms on 4,311 nodes, p99 20 ms of 5<!-- speed: ms; nodes; -; #2 -->.

<!-- figures: live -->
| scene | ms | found |
|---|---|---|
| idle | 2.5 (9.0) | 99 % |
| bent | 2.0 (7.4) | - |

<!-- figures: speed | | a.ROW; b.ROW | -->
| force | published | ours | remark |
|---|---|---|---|
| 5 N <!-- five --> | 8.0 | +1.0 of 2e-3 | 3 rounds |
| 10 N <!-- - --> | 9.0 | 4.0 | |
"""
SPEED = {"ms": 18.55, "nodes": 4311.4, "nodes #2": 5.1, "a.five": 1.02, "b.five": 2.04e-3}
LIVE = {
    "idle / ms": 2.5,
    "idle / ms #2": 9.0,
    "idle / found": 99.4,
    "bent / ms": 2.0,
    "bent / ms #2": 7.4,
}


def results(name, figures, quick=False):
    return Results(name, "", Provenance.now(0), 1.0, quick, figures)


def made(speed=SPEED, live=LIVE):
    return {"speed": results("speed", speed), "live": results("live", live)}


@pytest.mark.parametrize("page", pages(), ids=lambda page: page.name)
def test_rendering_changes_nothing_in_a_page(page):
    text = page.read_text(encoding="utf-8")
    assert rendered(text, PUBLISHED) == text


def test_a_number_altered_in_a_page_is_rendered_back():
    """Every one of them, in every page."""
    count = 0
    for page in pages():
        text = page.read_text(encoding="utf-8")
        parts, done = [], 0
        for each in figures_in(text):
            digit = each.written[-1]
            other = each.written[:-1] + str((int(digit) + 5) % 10)
            parts += [text[done : each.start], other]
            done = each.end
            count += 1
        altered = "".join([*parts, text[done:]])
        assert rendered(altered, PUBLISHED) == text, page
    assert count >= 1000


def test_numbers_are_written_as_those_before_them():
    assert rendered(PAGE, made()) == PAGE
    speed = SPEED | {"ms": 20.04, "nodes": 12345.6, "a.five": -1.26, "b.five": 0.04}
    live = LIVE | {"idle / ms #2": 10.0, "idle / found": 100.0}
    new = rendered(PAGE, made(speed, live))
    assert "takes 20.0 ms on 12,346 nodes, p99 20 ms of 5<!--" in new
    assert "| idle | 2.5 (10.0) | 100 % |" in new
    assert "| 8.0 | -1.3 of 4e-2 | 3 rounds |" in new
    assert "| 9.0 | 4.0 | |" in new


@pytest.mark.parametrize(
    ("written", "value", "new"),
    [
        ("18.6", 9.04, "9.0"),
        ("623", 1623.0, "1623"),
        ("4,311", 623.0, "623"),
        ("-3.2", 2.0, "2.0"),
        ("+3.2", 2.0, "+2.0"),
        ("2.6e-3", 1.234e-12, "1.2e-12"),
        ("4.65e+03", 12345.0, "1.23e+04"),
        ("0.00046", 0.0, "0.00000"),
    ],
)
def test_notation_of_a_number_is_kept(written, value, new):
    assert rewritten(written, value) == new


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("speed: ms; nodes", "sped: ms; nodes", "'ms' of sped for 18.6, got none"),
        ("speed: ms; nodes", "speed: ms; node", "'node' of speed"),
        ("-; #2 -->", "-; #2; a; b; c -->", "expected 7 numbers"),
        ("figures: speed | | a", "figures: speed | a", "expected 3 patterns.*got 2"),
        ("<!-- five -->", "<!-- six -->", "'a.six'"),
        ("<!-- figures: live -->\n", "<!-- figures: live -->\n\n", "right above its table"),
        ("9.0) |", "9.0 of 3) |", "'idle / ms #3' of live"),
    ],
)
def test_comments_that_do_not_fit_are_refused(old, new, message):
    assert PAGE.count(old) == 1
    with pytest.raises(ConfigurationError, match=message):
        rendered(PAGE.replace(old, new), made())


def test_the_script_writes_pages_by_the_results_of_another_run(tmp_path, monkeypatch, capsys):
    (tmp_path / "docs").mkdir()
    page = tmp_path / "README.md"
    page.write_text(PAGE)
    (tmp_path / "docs" / "plain.md").write_text("42\n")
    published, out = tmp_path / "published", tmp_path / "out"
    for one in made().values():
        Report(one).write(published)
    monkeypatch.setattr(page_figures.pages, "__defaults__", (tmp_path,))
    monkeypatch.setattr(page_figures.full_results, "__defaults__", (published,))
    monkeypatch.setattr(page_figures, "ROOT", tmp_path)
    page_figures.main([])
    assert page.read_text() == PAGE
    assert capsys.readouterr().out == ""
    Report(results("live", LIVE | {"idle / found": 12.0})).write(out)
    Report(results("speed", SPEED | {"ms": 1.0}, quick=True)).write(out)
    page_figures.main([str(out)])
    assert page.read_text() == PAGE.replace("99 %", "12 %")
    assert capsys.readouterr().out == "changed: README.md\n"
    page_figures.main([])
    assert page.read_text() == PAGE
