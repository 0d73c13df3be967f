"""Pages of results are those of the published results, and so is what other pages quote."""

import pytest

from eitskin.benchmarks.result_pages import (
    full_results,
    pages,
    result_page,
    rewritten,
    with_figures,
)
from eitskin.benchmarks.results import Results
from eitskin.errors import ConfigurationError
from eitskin.provenance import Provenance

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


@pytest.mark.parametrize("keys", [{"two touches": []}, {"one touch": ["", "touch.none"]}])
def test_rows_and_figures_that_are_missing_are_refused(keys):
    with pytest.raises(ConfigurationError, match="quoted"):
        with_figures(PAGE, keys, results({"touch.error_mm": 1.0}))


@pytest.mark.parametrize(
    ("written", "value", "new"),
    [("18.6", 9.04, "9.0"), ("4,311", 12345.6, "12,346")],
)
def test_notation_of_a_number_is_kept(written, value, new):
    assert rewritten(written, value) == new


def test_a_page_has_a_table_for_rows_of_the_same_columns():
    page = result_page(
        results({"a / x [mm]": 1.5, "a / y": 2.0, "b / x [mm]": 3.0, "time.p50": 4.0})
    )
    assert "| | x [mm] | y |\n|---|---|---|\n| a | 1.5 | 2 |\n| b | 3 |  |\n" in page
    assert "| | p50 |\n|---|---|\n| time | 4 |\n" in page
    assert "eitskin bench paper" in page
