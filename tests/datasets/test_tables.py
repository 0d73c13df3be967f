"""Tables of recordings in the forms that loggers and boards write them."""

import numpy as np
import pytest

from eitskin.datasets import RecordingNames, read_recording
from eitskin.errors import ConfigurationError, DataError

VALUES = [[-1.5, 2.25, 3, 4], [5, 6.5, 7, 8]]
ROWS = "-1.5,2.25,3,4\n5,6.5,7,8\n"
NAMES = "v0,v1,v2,v3\n"


@pytest.mark.parametrize(
    "text",
    [
        NAMES + ROWS.replace("\n", ", \n"),  # separators behind the rows alone,
        NAMES.replace("\n", ",,\n") + ROWS,  # the header alone,
        (NAMES + ROWS).replace("\n", ";\n").replace(",", ";"),  # or both
        "UTC:,2026-03-01 10:00:00.123\nIsrc [A]:,0.001\n" + NAMES + ROWS,
        "a logger\n" * 30 + "\n" + NAMES + ROWS,
        "a logger,,,\n\n" + NAMES + ROWS,  # as spreadsheets save it
        NAMES + "(V),(V),(mV),[ohm]\n\n" + ROWS,
        "v0 [ohm],v1 [ohm],v2 [ohm],v3 [ohm]\n" + ROWS,
        "Zeit: 3\n" + (NAMES + ROWS).replace(",", "\t").replace(".", ","),
        (NAMES + ROWS).replace(",", " ").replace(".", ","),
        "\ufeff" + NAMES.replace(",", ";") + ROWS.replace(",", ";").replace(".", ","),
    ],
)
def test_a_header_is_found_above_rows_of_any_form(tmp_path, text):
    (tmp_path / "a.csv").write_text(text, encoding="utf-8")
    assert np.array_equal(read_recording(tmp_path / "a.csv").impedance, VALUES)


@pytest.mark.parametrize("row", ["[{}],", "[[{}]", "{{{}}}", "{},", "{} , , "])
def test_rows_without_a_header_have_brackets_and_separators(tmp_path, row):
    text = "".join(row.format(line.replace(",", ", ")) + "\n" for line in ROWS.split())
    (tmp_path / "a.csv").write_text(text, encoding="utf-8")
    assert np.array_equal(read_recording(tmp_path / "a.csv", RecordingNames("c")).impedance, VALUES)


def test_a_row_of_names_is_given_and_refusals_quote_and_help(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("w0,w1,w2,w3\nof,two,volt,meters\n" + NAMES + ROWS)
    assert np.array_equal(read_recording(path, RecordingNames(header_row=3)).impedance, VALUES)
    with pytest.raises(DataError, match="--header-row"):
        read_recording(path, RecordingNames(header_row=7))
    path.write_text(NAMES.replace("v", "ch") + ROWS)
    with pytest.raises(ConfigurationError, match="--values ch"):
        read_recording(path)
    path.write_text(NAMES + "1,2,3\n")
    with pytest.raises(DataError, match="'1,2,3'"):
        read_recording(path)


def test_a_sheet_has_a_preamble(tmp_path):
    openpyxl = pytest.importorskip("openpyxl")
    book = openpyxl.Workbook()
    for line in (["logger", "7"], [], ["v0", "v1", "v2", "v3"], *VALUES):
        book.active.append(line)
    book.save(tmp_path / "a.xlsx")
    assert np.array_equal(read_recording(tmp_path / "a.xlsx").impedance, VALUES)
