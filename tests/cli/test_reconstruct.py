"""`eitskin reconstruct`: pictures of scenes, datasets and boards."""

import json

import numpy as np
import pytest
from command_line import printed_json, run
from scipy.io import savemat

from eitskin.datasets import Dataset, save_dataset
from eitskin.datasets.recordings.protocols import in_order
from eitskin.errors import DataError
from eitskin.geometry import Disc, Inclusion, SensorDesign
from eitskin.geometry.design.regular_layouts import uniform
from eitskin.simulator import ForwardModel, Protocol

import small_dataset

pytestmark = pytest.mark.slow

FEW = ("--pixels", "200", "--resolution", "coarse")


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    data = small_dataset.make(n=6, status=np.zeros((6, 28)))
    folder = tmp_path_factory.mktemp("data") / "set"
    save_dataset(data, folder)
    return folder


def test_scene_is_pictured_where_it_is_touched(tmp_path):
    (tmp_path / "touched.toml").write_text("[[touches]]\nx = 0.05\ny = 0.035\nforce = 5.0\n")
    picture = tmp_path / "picture.png"
    found = printed_json("reconstruct", tmp_path / "touched.toml", *FEW, "--out", picture)
    (one,) = found["pictures"]
    assert one["method"] == "greit"
    assert one["difference"] == "relative"
    assert one["least"] < 0.0
    assert np.hypot(*np.subtract(one["least_at_m"], (0.05, 0.035))) < 0.01
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_frames_of_a_dataset_by_several_methods(dataset, tmp_path):
    out = tmp_path / "pictures.npz"
    words = ("reconstruct", dataset, *FEW, "--frames", "0,2-3", "--method", "all", "--out", out)
    found = printed_json(*words)
    assert len(found["pictures"]) == 18
    with np.load(out) as written:
        assert written["change"].shape == (6, 3, len(written["y"]), len(written["x"]))
        assert written["frames"].tolist() == ["frame 0", "frame 2", "frame 3"]
        inner = written["change"][..., written["inside"]]
    assert np.isfinite(inner).all()
    table = tmp_path / "values.csv"
    run("reconstruct", dataset, *FEW, "--frames", "2", "--out", table, "-q")
    assert table.read_text().startswith("x_m,y_m,frame 2\n")
    assert np.loadtxt(table, delimiter=",", skiprows=1)[:, 2] == pytest.approx(inner[5, 1])


def test_boards_are_pictured_after_a_reference_that_is_chosen(dataset):
    """A recording of fewer frames than the reference has, which ends by itself."""
    words = ("reconstruct", f"replay:{dataset}", *FEW, "--average", "3", "--frames", "2")
    found = printed_json(*words, "--method", "noser", "--lambda", "gcv")
    assert [one["frame"] for one in found["pictures"]] == ["frame 3", "frame 4"]
    assert found["pictures"][0]["lambda"] is None
    words = ("reconstruct", f"replay:{dataset}", *FEW, "--page", "--page-port", "0")
    assert "page: http://127.0.0.1:" in run(*words).stderr
    words = ("reconstruct", dataset, *FEW, "--frames", "2", "--reference")
    same = printed_json(*words, "2")["pictures"][0]
    assert same["least"] == same["largest"] == 0.0
    assert printed_json(*words, "flat") != printed_json(*words, "untouched")


def test_order_is_tested_impossible_changes_are_cut_and_noise_is_named(tmp_path):
    """Frames in rotated order, named in given order; then one that fits no sensor; then noise."""
    design = SensorDesign(Disc(0.05), 0.005, uniform(Disc(0.05), 16))
    design.to_toml(tmp_path / "disc.toml")
    rotated = in_order(Protocol.adjacent(16), "rotated")
    values = rotated.measure(ForwardModel(design, "coarse").impedance())
    factors = np.random.default_rng(0).uniform(0.1, 5.0, len(values))
    still = values * np.random.default_rng(1).normal(1.0, 1e-3, (8, len(values)))
    frames = np.stack([values, values * factors, *still])
    save_dataset(Dataset.from_arrays(frames, frames[:1]), tmp_path / "set")
    words = ("reconstruct", tmp_path / "set", "--sensor", tmp_path / "disc.toml", *FEW)
    words += ("--protocol", "adjacent", "--frames", "1", "--segment", "--reference")
    with pytest.raises(DataError, match="--order rotated"):
        run(*words, "0")
    words += ("2-8", "--order", "rotated")
    ran = run(*words, "--method", "greit", "--lambda", "lambda:1e-4", "--json")
    (one,) = json.loads(ran.stdout)["pictures"]
    assert (one["least"], one["least_is_noise"]) == (-1.0, False)
    assert "by more than 100 %" in ran.stderr
    assert {region["sign"] for region in one["regions"]} <= {-1, 1}
    (one,) = printed_json(*words, "--frames", "9")["pictures"]
    assert one["least_is_noise"]
    assert one["largest_is_noise"]


def test_regions_of_a_tank_against_a_recording_of_plain_water(tmp_path):
    """Files that say their patterns, with lost channels and some of the reference near zero."""
    design = SensorDesign(Disc(0.05), 0.005, uniform(Disc(0.05), 16))
    design.to_toml(tmp_path / "disc.toml")
    protocol = Protocol.adjacent(16, shared=True)
    drive, sense = protocol.patterns()
    places = {-1: (0.035, 0.06), 1: (0.07, 0.045)}
    targets = [Inclusion.cylinder(*place, 0.01, 100.0**sign) for sign, place in places.items()]
    for name, inclusions in (("water", ()), ("targets", targets)):
        Z = ForwardModel(design, "coarse", inclusions=inclusions).impedance(1.0)
        values = 2e-3 * protocol.measure(Z)
        values[[20, 100, 180]] = (1e-9, -1e-9, 1e-9) if name == "water" else np.nan
        savemat(
            tmp_path / f"{name}.mat",
            {"Inj": 2e-3 * drive[:, ::16], "Mpat": sense[:, :16], "U": values},
        )
    words = ("reconstruct", tmp_path / "targets.mat", "--reference", tmp_path / "water.mat")
    found = printed_json(*words, "--sensor", tmp_path / "disc.toml", "--segment", *FEW)
    (one,) = found["pictures"]
    assert (one["method"], one["difference"]) == ("laplace", "absolute")
    regions = {region["sign"]: region for region in one["regions"]}
    assert len(one["regions"]) == 2
    for sign, place in places.items():
        assert np.hypot(*np.subtract(regions[sign]["centre"], place)) < 0.006
    assert regions[-1]["change"] >= -1
