"""Sensors that are taken through the whole chain, and the files that a user writes for each."""

from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlencode

DESIGN, RECIPE, OWN_RECIPE = "sensor.toml", "recipe.toml", "own-recipe.toml"
PRESS, SESSION = "press.toml", "session.toml"
RIG = "rig.toml"
FORCES = (6.0, 12.0)  # N, of the presses that are learned from
PRESS_FORCE = 8.0  # N, of the press that is shown live and pictured


@dataclass(frozen=True, slots=True)
class ChainCase:
    """Sensor, protocol and the numbers of frames to make of it.

    Attributes:
        name: of its folder and its figures.
        design: TOML of its design.
        press: place of the press that is shown live and pictured (x, y) [m].
        protocol: name of its protocol.
        idle, touched: frames of the recipe, of `specimens` specimens.
        own: presses of one sensor that is in no set.
        specimens: number of sensors in the recipe.
        spread: standard deviations of `[specimens]`, by key.
        instrument: TOML of its board; empty for white noise alone.
    """

    name: str
    design: str
    press: tuple[float, float]
    protocol: str = "pairwise"
    idle: int = 160
    touched: int = 240
    own: int = 300
    specimens: int = 10
    spread: str = "conductivity = 0.15\ncontact_impedance = 0.15\nelectrode_place = 0.0005"
    instrument: str = ""

    @property
    def folder(self) -> str:
        """Name of its folder."""
        return self.name.replace(", ", "-").replace(" ", "-")

    def write(self, folder: Path) -> None:
        """Write design, recipes and scenes into a folder."""
        files = {
            DESIGN: self.design,
            RECIPE: self._recipe(self.specimens, self.idle, self.touched, seed=1),
            OWN_RECIPE: self._recipe(1, 0, self.own, seed=2),
            PRESS: self._press("touches"),
            SESSION: f"[[steps]]\nframes = 10\n\n[[steps]]\nframes = 10\n"
            f"{self._press('steps.scene.touches')}",
        }
        if self.instrument:
            files[RIG] = self.instrument
        for name, text in files.items():
            (folder / name).write_text(text, encoding="utf-8")

    def board(self, **options: str) -> str:
        """URI of the virtual board of the sensor."""
        told = {"sensor": DESIGN, "protocol": self.protocol, "speed": "max"} | options
        told |= {"instrument": RIG} if self.instrument else {}
        return f"virtual:?{urlencode(told)}"

    def _recipe(self, specimens: int, idle: int, touched: int, seed: int) -> str:
        untouched = f'[[scenes]]\nstate = "idle"\ncount = {idle}\n\n' if idle else ""
        board = f'[instrument]\nboard = "{RIG}"\n\n' if self.instrument else ""
        return (
            f'name = "{self.name}"\nseed = {seed}\nsensor = "{DESIGN}"\n'
            f'protocol = "{self.protocol}"\nresolution = "coarse"\nframes_per_shard = 100\n\n'
            f"{board}[specimens]\ncount = {specimens}\n{self.spread}\n\n{untouched}"
            f'[[scenes]]\nstate = "touch"\ncount = {touched}\nforce = [{FORCES[0]}, {FORCES[1]}]\n'
        )

    def _press(self, table: str) -> str:
        x, y = self.press
        return f"[[{table}]]\nx = {x}\ny = {y}\nforce = {PRESS_FORCE}\n"


def _rectangle(electrodes: str) -> str:
    return (
        "thickness = 0.005\noutline = { length = 0.150, width = 0.060 }\n"
        f"electrodes = {electrodes}\n"
    )


PLACED = "conductivity = 0.15\ncontact_impedance = 0.15"  # pads keep their places
CASES = (
    ChainCase(
        "round, adjacent",
        "thickness = 0.005\noutline = { radius = 0.050 }\n"
        "electrodes = { count = 16, width = 0.004 }\n",
        press=(0.035, 0.060),
        protocol="adjacent",
    ),
    ChainCase(
        "rectangle, pairwise", _rectangle("{ count = 8, start = 0.0225 }"), press=(0.050, 0.020)
    ),
    ChainCase(
        "rectangle, 32 electrodes, adjacent",
        _rectangle("{ count = 32, width = 0.004, start = 0.009375 }"),
        press=(0.050, 0.020),
        protocol="adjacent",
    ),
    ChainCase(
        "rectangle, electrodes inside",
        _rectangle('{ rows = 2, columns = 4, size = 0.006, on = "inside", z = 0.001 }'),
        press=(0.050, 0.020),
        spread=PLACED,
    ),
    ChainCase(
        "rectangle, pads on top",
        _rectangle('{ rows = 2, columns = 4, size = 0.006, on = "top" }'),
        press=(0.050, 0.020),
        spread=PLACED,
    ),
    ChainCase(
        "L-shaped, 12 electrodes, adjacent",
        "thickness = 0.005\noutline = { points = [\n    [0.0, 0.0], [0.100, 0.0], [0.100, 0.045], "
        "[0.045, 0.045], [0.045, 0.100], [0.0, 0.100],\n] }\n"
        "electrodes = { count = 12, width = 0.004, start = 0.0125 }\n",
        press=(0.025, 0.060),
        protocol="adjacent",
    ),
    ChainCase(
        "rectangle, no ideal meter, opposite",
        _rectangle("{ count = 8, start = 0.0225 }"),
        press=(0.050, 0.020),
        protocol="opposite",
        instrument="snr_db = 70.0\n\n[meter]\nsink = 2e-4\nidle = 2e-5\n"
        'common_mode = -0.02\nscale = 12.0\nreads = "magnitude"\n',
    ),
)
