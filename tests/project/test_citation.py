"""The citation file says what the package and the cards of exported datasets say."""

import tomllib
from pathlib import Path

import numpy as np
import yaml

import eitskin
from eitskin.datasets import Dataset
from eitskin.datasets.export.export import PAPER, card

ROOT = Path(__file__).resolve().parents[2]
CITATION = yaml.safe_load((ROOT / "CITATION.cff").read_text())
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def test_version_and_licence_are_those_of_the_package() -> None:
    assert CITATION["version"] == eitskin.__version__
    assert CITATION["license"] == PROJECT["license"]


def test_cards_cite_the_same_software_and_paper() -> None:
    (paper,) = CITATION["references"]
    assert paper["title"] in PAPER
    assert paper["journal"] in PAPER
    assert paper["doi"] in PAPER
    assert all(each["family-names"] in PAPER for each in paper["authors"])
    data = Dataset.from_arrays(np.ones((1, 1)))
    assert CITATION["title"] in card("set", "mit", {"train": (1, 1)}, data, ())
