"""`eitskin mesh`: numbers, and what is refused."""

import pytest
from command_line import printed_json, run

from eitskin.errors import ConfigurationError


@pytest.mark.parametrize("kind", ["hexahedra", "prisms"])
def test_the_numbers_are_those_of_the_reference_sensor(kind) -> None:
    found = printed_json("mesh", "--cells", kind, "--resolution", "fast")
    assert found["kind"] == kind
    assert found["volume"] == pytest.approx(0.150 * 0.060 * 0.005)
    assert found["electrodes"] == 8
    assert found["electrode_area_error"] < 1e-9
    assert found["cells"] > 100
    assert 0.0 < found["scaled_jacobian"] <= 1.0 + 1e-12


def test_a_design_file_is_meshed_by_what_suits_it(tmp_path) -> None:
    (tmp_path / "disc.toml").write_text(
        "outline = { radius = 0.03 }\nthickness = 0.004\n[electrodes]\ncount = 6\nwidth = 0.004\n"
    )
    found = printed_json("mesh", "--sensor", str(tmp_path / "disc.toml"))
    assert found["kind"] == "prisms"
    assert found["electrodes"] == 6


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--cells", "cubes"), r"--cells.*hexahedra, prisms, tetrahedra"),
        (("--resolution", "best"), r"resolution.*fast, standard, fine"),
        (("--drive", "0,4"), "name the picture with --view"),
        (("--drive", "0", "--view", "x.png"), "as 0-4"),
        (("--drive", "0,8", "--view", "x.png"), "from 0 to 7"),
        (("--drive", "3,3", "--view", "x.png"), "two different electrodes"),
        (("--view", "/nowhere/at/all.png", "--resolution", "fast"), "cannot write"),
    ],
)
def test_what_cannot_be_is_refused(options, message) -> None:
    with pytest.raises(ConfigurationError, match=message):
        run("mesh", *options)
