"""Schematic of a board from a NUCLEO-F411RE, an AD5940 shield and four ADG706, as SVG.

    python docs/how-to/board/schematic.py

writes schematic.svg beside this file. The pins come from the firmware's wiring.csv.
"""

import csv
from pathlib import Path
from xml.sax.saxutils import escape

HERE = Path(__file__).parent
WIRING = HERE.parents[2] / "hardware" / "firmware" / "nucleo_f411" / "wiring.csv"
WIDTH, HEIGHT = 1180, 1080
PITCH = 18  # from pin to pin
BODY, WIRE, NET, SUPPLY = "#fdf6e3", "#333333", "#0b5394", "#a61c00"

# ADG706BRUZ, TSSOP-28: pin numbers by the data sheet.
ADDRESS = {"A0": 17, "A1": 16, "A2": 15, "A3": 14}
SUPPLIES = {"EN": (18, "3V3"), "VDD": (1, "3V3"), "VSS": (27, "GND"), "GND": (12, "GND")}
OUTPUT = 28
INPUTS = [19, 20, 21, 22, 23, 24, 25, 26, 11, 10, 9, 8, 7, 6, 5, 4]  # S1 to S16

AFE_PINS = ("SPI clock", "SPI in", "SPI out", "chip select", "reset", "interrupt")
MUXES = {"U1": ("F+", "F+ electrode"), "U2": ("F-", "F- electrode"), "U3": ("S+", "AIN2")}
MUXES |= {"U4": ("S-", "AIN3")}


def text(x: float, y: float, content: str, anchor: str = "start", **style: str) -> str:
    """One line of text; style keys are attributes of SVG."""
    attributes = "".join(f' {key.replace("_", "-")}="{value}"' for key, value in style.items())
    return f'<text x="{x}" y="{y}" text-anchor="{anchor}"{attributes}>{escape(content)}</text>'


def line(*points: tuple[float, float]) -> str:
    """A wire through these points."""
    path = " ".join(f"{x},{y}" for x, y in points)
    return f'<polyline points="{path}" fill="none" stroke="{WIRE}" stroke-width="1.2"/>'


def net(x: float, y: float, name: str, to_left: bool) -> str:
    """The name of the net at the end of a pin."""
    colour = SUPPLY if name in {"3V3", "GND"} else NET
    anchor, shift = ("end", -4) if to_left else ("start", 4)
    return text(x + shift, y + 4, name, anchor, fill=colour)


def block(
    place: tuple[float, float], width: float, title: str, left: list, right: list, stub: int = 26
) -> list[str]:
    """A part at its upper left corner: its pins are (name, number, net), from top to bottom."""
    x, y = place
    height = PITCH * (max(len(left), len(right)) + 1)
    drawn = [
        f'<rect x="{x}" y="{y}" width="{width}" height="{height}" fill="{BODY}" stroke="{WIRE}"/>',
        text(x + width / 2, y - 7, title, "middle", font_weight="bold"),
    ]
    for pins, edge, outward in ((left, x, -1), (right, x + width, 1)):
        for row, (name, number, connected) in enumerate(pins, start=1):
            at, end = y + PITCH * row, edge + outward * stub
            inside = "end" if outward > 0 else "start"
            drawn.append(line((edge, at), (end, at)))
            drawn.append(text(edge - outward * 5, at + 4, name, inside))
            middle = edge + outward * stub / 2
            drawn.append(text(middle, at - 2, number, "middle", font_size="8"))
            drawn.append(net(end, at, connected, outward < 0))
    return drawn


def in_series(x: float, y: float, left: str, part: str, right: str, capacitor: bool) -> list[str]:
    """A resistor or capacitor between two nets, on one line."""
    centre = x + 90
    gap = 4 if capacitor else 16
    drawn = [
        net(x, y, left, to_left=True),
        line((x, y), (centre - gap, y)),
        line((centre + gap, y), (x + 180, y)),
        net(x + 180, y, right, to_left=False),
        text(centre, y - 13, part, "middle"),
    ]
    if capacitor:
        drawn += [line((centre + s, y - 9), (centre + s, y + 9)) for s in (-gap, gap)]
    else:
        corners = [(-16, -6), (16, -6), (16, 6), (-16, 6), (-16, -6)]
        drawn.append(line(*[(centre + dx, y + dy) for dx, dy in corners]))
    return drawn


def nucleo(rows: list[dict[str, str]]) -> list[str]:
    """The microcontroller's board."""
    pins = [(row["pin"], row["header"], row["signal"]) for row in rows if "CN" in row["header"]]
    spi = [(row["pin"], row["header"], row["signal"]) for row in rows if row["signal"] in AFE_PINS]
    left = [*spi, ("3V3", "", "3V3"), ("GND", "", "GND")]
    wide = [(name, header.replace("-", "."), signal) for name, header, signal in pins]
    return block((170, 60), 130, "NUCLEO-F411RE", left, wide, stub=50)


def front_end(rows: list[dict[str, str]]) -> list[str]:
    """The AD5940's shield."""
    there = {row["signal"]: row for row in rows}
    left = [
        (there[pin]["goes to"].removeprefix("AD5940 "), there[pin]["header"], pin)
        for pin in AFE_PINS
    ]
    left += [("3V3", "", "3V3"), ("GND", "", "GND")]
    right = [(name, "", name) for name in ("CE0", "AIN1", "AIN2", "AIN3", "RCAL0", "RCAL1")]
    return block((170, 440), 130, "AD5940 shield", left, right, stub=50)


def multiplexer(name: str, x: float, y: float, rows: list[dict[str, str]]) -> list[str]:
    """One ADG706."""
    role, common = MUXES[name]
    signals = {row["goes to"]: row["signal"] for row in rows}
    left: list = [("D", str(OUTPUT), common)]
    left += [(pin, str(number), signals[f"{name} {pin}"]) for pin, number in ADDRESS.items()]
    left += [(pin, str(number), to) for pin, (number, to) in SUPPLIES.items()]
    right = [(f"S{n}", str(pin), f"E{n}") for n, pin in enumerate(INPUTS, start=1)]
    return block((x, y), 90, f"{name}  ADG706BRUZ  ({role})", left, right)


def analog() -> list[str]:
    """Coupling, bias, calibration and decoupling."""
    parts = [
        ("CE0", "C1 1 µF", "F+ electrode", True),
        ("AIN1", "C2 1 µF", "F- electrode", True),
        ("3V3", "R1 2 MΩ", "F- electrode", False),
        ("F- electrode", "R2 1 MΩ", "GND", False),
        ("RCAL0", "R3 200 Ω 0.1 %", "RCAL1", False),
        ("3V3", "C3 to C6 100 nF, at U1 to U4", "GND", True),
        ("3V3", "C7 10 µF", "GND", True),
    ]
    drawn = []
    for place, (left, part, right, capacitor) in enumerate(parts):
        drawn += in_series(150, 720 + 54 * place, left, part, right, capacitor)
    return drawn


def draw(rows: list[dict[str, str]]) -> str:
    """The schematic of a wiring."""
    drawn = [*nucleo(rows), *front_end(rows), *analog()]
    for place, name in enumerate(MUXES):
        x, y = (650, 950)[place % 2], (60, 440)[place // 2]
        drawn += multiplexer(name, x, y, rows)
    notes = (
        "Wires of one name are one net.",
        "E1 to E16: electrodes 0 to 15 of the firmware's table. A sensor of eight has E1 to E8.",
        "Drawn from published pin assignments; no such board has been built yet.",
    )
    drawn += [text(560, 830 + 20 * place, note) for place, note in enumerate(notes)]
    return "\n".join(
        [
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" '
            f'width="{WIDTH}" height="{HEIGHT}" font-family="sans-serif" font-size="11">',
            f'<rect width="{WIDTH}" height="{HEIGHT}" fill="white"/>',
            *drawn,
            "</svg>\n",
        ]
    )


if __name__ == "__main__":
    with WIRING.open(encoding="utf-8") as file:
        wiring = list(csv.DictReader(file))
    (HERE / "schematic.svg").write_text(draw(wiring), encoding="utf-8")
