"""The board that can be built: page, schematic, wiring and parts agree."""

import csv
import re
import runpy
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "hardware" / "firmware" / "nucleo_f411"
PAGE = FOLDER / "README.md"
SCHEMATIC = ROOT / "docs" / "how-to" / "board" / "schematic.py"
COMMON = {"U1": "CE0, by C1", "U2": "AIN1, by C2", "U3": "AIN2", "U4": "AIN3"}


def rows(name):
    with (FOLDER / name).open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_the_schematic_is_what_its_script_draws():
    drawn = runpy.run_path(str(SCHEMATIC))["draw"](rows("wiring.csv"))
    assert SCHEMATIC.with_suffix(".svg").read_text(encoding="utf-8") == drawn


def test_the_page_has_the_wires_of_the_multiplexers():
    wires = {row["goes to"]: row for row in rows("wiring.csv")}
    for part, role in zip(COMMON, ("F+", "F-", "S+", "S-"), strict=True):
        lines = [wires[f"{part} A{line}"] for line in range(4)]
        assert all(row["signal"].startswith(f"{role} A") for row in lines)
        cells = [f"{row['pin']}, {row['header']}" for row in lines]
        table_row = f"| {part} ({role}) | {' | '.join(cells)} | {COMMON[part]} |"
        assert table_row in PAGE.read_text(encoding="utf-8")


def test_the_firmware_drives_the_wires_of_the_multiplexers():
    source = (FOLDER / "front_end.c").read_text(encoding="utf-8")
    names = {"F+": "DRIVE_PLUS", "F-": "DRIVE_MINUS", "S+": "SENSE_PLUS", "S-": "SENSE_MINUS"}
    pins = {row["signal"]: row["pin"] for row in rows("wiring.csv")}
    assert len(set(pins.values())) == len(pins) == 24
    for role, name in names.items():
        (line,) = re.findall(rf"\[EIT_{name}\] = (.*),", source)
        driven = [f"P{port}{number}" for port, number in re.findall(r"GPIO(\w), (\d+)", line)]
        assert driven == [pins[f"{role} A{line}"] for line in range(4)]


def test_every_part_of_the_schematic_can_be_bought():
    bought = {part for row in rows("bill_of_materials.csv") for part in row["reference"].split()}
    drawn = SCHEMATIC.with_suffix(".svg").read_text(encoding="utf-8")
    shown = {"U1", "U2", "U3", "U4", "C1", "C2", "C7", "R1", "R2", "R3"}
    assert all(part in drawn for part in shown)
    assert bought == shown | {"C3", "C4", "C5", "C6"}
