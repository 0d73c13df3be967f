"""Results of benchmarks: one writer, one folder; tables read back as figures."""

import csv
import math

import pytest

from eitskin.benchmarks.result_pages import (
    full_results,
    pages,
    result_section,
    rewritten,
    with_figures,
)
from eitskin.benchmarks.results import (
    Report,
    ReportTable,
    Results,
    found_results,
    make_results,
    read_results,
    write_index,
)
from eitskin.errors import ConfigurationError, DataError
from eitskin.provenance import Provenance

PICTURE = {"p.png": lambda path: path.write_bytes(b"p")}


def made(name="one", quick=False, seed=0):
    figures = {"a": 1.5, "b": 2.0}
    return Results(name, "eitskin bench one", Provenance.now(seed), 3.0, quick, figures)


def test_what_is_written_is_read_and_named_in_the_index(tmp_path):
    results = made()
    paths = Report(results, plots=PICTURE).write(tmp_path)
    assert [path.name for path in paths] == ["p.png", "table.csv", "results.json"]
    assert read_results(tmp_path / "one" / "results.json") == results
    comment, *lines = (tmp_path / "one" / "table.csv").read_text().splitlines()
    assert comment == f"# {results.provenance}"
    rows = [{"figure": "a", "value": "1.5"}, {"figure": "b", "value": "2.0"}]
    assert list(csv.DictReader(lines)) == rows
    Report(made("two", quick=True)).write(tmp_path)
    (tmp_path / "frames").mkdir()  # no results in it
    assert [each.name for each in found_results(tmp_path)] == ["one", "two"]
    text = write_index(tmp_path).read_text()
    for part in ("| one | 2 | 3 | 0 | ", "| two, quick | 2 |", "[p.png](one/p.png)"):
        assert part in text


def test_a_figure_that_is_no_number_is_left_out():
    figures = {"a": 1.0, "b": math.nan, "c": math.inf}
    assert make_results("one", figures.items(), began=0.0).figures == {"a": 1.0}


def test_a_picture_that_fails_leaves_no_results_that_vouch_for_it(tmp_path):
    def broken(path):
        path.write_bytes(b"half")
        raise OverflowError

    with pytest.raises(OverflowError):
        Report(made(), plots={"p.png": broken}).write(tmp_path)
    assert list((tmp_path / "one").iterdir()) == []


@pytest.mark.parametrize("text", ['{"name": "half', '{"name": 3}'])
def test_results_that_cannot_be_read_are_refused_with_what_to_do(tmp_path, text):
    path = tmp_path / "results.json"
    path.write_text(text)
    with pytest.raises(DataError, match="--fresh"):
        read_results(path)


def test_numbers_of_a_table_are_figures_by_title_row_and_heading():
    heads = ("board", "scene", "frames/s", "ms: p50 (p99)")
    rows = [("fast", "idle", "1,297.4", "2.56 (9.01)"), ("fast", "bent", "full queue", "2.0e-3")]
    assert dict(ReportTable(heads, rows).figures("times")) == {
        "times / fast, idle / frames/s": 1297.4,
        "times / fast, idle / ms: p50 (p99)": 2.56,
        "times / fast, idle / ms: p50 (p99) #2": 9.01,
        "times / fast, bent / ms: p50 (p99)": 2.0e-3,
    }
    columns = {"row": ("name", "", 1), "a [%]": ("a", ".1f", 100.0)}
    values = [{"name": "error", "a": 0.01}, {"name": "error", "a": None}, {"name": "  of it"}]
    table = ReportTable.from_rows(values, columns)
    assert table.rows == [("error", "1.0"), ("error", ""), ("  of it", "")]
    assert dict(table.figures()) == {"error / a [%]": 1.0}


# Pages

PAGE = "| | published | ours |\n|---|---|---|\n| one touch | 4.8 mm | 1.1 mm |\n"
KEYS = {"one touch": ["", "touch.error_mm"]}


def results(figures):
    return Results("paper", "eitskin bench paper", Provenance.now(0), 1.0, False, figures)


def test_every_page_shows_what_is_published():
    for page, text in pages(full_results()).items():
        assert page.read_text(encoding="utf-8") == text, "run `make pages`"


def test_a_quoted_figure_follows_its_result():
    assert with_figures(PAGE, KEYS, results({"touch.error_mm": 1.14})) == PAGE
    changed = with_figures(PAGE, KEYS, results({"touch.error_mm": 2.26}))
    assert changed == PAGE.replace("1.1 mm", "2.3 mm")
    assert (rewritten("18.6", 9.04), rewritten("4,311", 12345.6)) == ("9.0", "12,346")
    for keys in ({"two touches": []}, {"one touch": ["", "touch.none"]}):
        with pytest.raises(ConfigurationError, match="quoted"):
            with_figures(PAGE, keys, results({"touch.error_mm": 1.0}))


def test_a_page_has_a_table_for_rows_of_the_same_columns():
    figures = {"a / x [mm]": 1.5, "a / y": 2.0, "b / x [mm]": 3.0, "time.p50": 4.0, "c / y": 5.0}
    page = result_section(results(figures | {"a / y +-": 0.25}), "T", shown="[^c].*")
    assert "| | x [mm] | y |\n|---|---|---|\n| a | 1.5 | 2 ± 0.25 |\n| b | 3 |  |\n" in page
    assert "| | p50 |\n|---|---|\n| time | 4 |\n" in page
    assert "eitskin bench paper" in page
