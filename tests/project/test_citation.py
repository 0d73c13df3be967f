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


def test_it_has_what_the_format_requires() -> None:
    assert CITATION["cff-version"] == "1.2.0"
    assert all(CITATION[name] for name in ("message", "title", "authors"))


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


def test_the_newest_version_of_the_changes_is_this_one_or_its_successor() -> None:
    lines = (ROOT / "CHANGELOG.md").read_text().splitlines()
    versions = [line.split()[1].rstrip(",") for line in lines if line.startswith("## ")]
    assert eitskin.__version__.startswith(versions[0]) or any(
        eitskin.__version__.startswith(version) for version in versions[1:2]
    )
