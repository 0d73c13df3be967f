"""The film of the demo's report: what moves in it is what the episode's rows say."""

from xml.etree import ElementTree

import numpy as np
import pytest

from eitskin.cli.demo import live_episode as film
from eitskin.geometry import SensorDesign

SPACE = "{http://www.w3.org/2000/svg}"
PLACES = [[40.0, 20.0], [110.0, 40.0]]


def row(state, angle, true_angle, found, true, frames=2):
    return {
        "states": [state] * frames,
        "angles_deg": [angle] * frames,
        "true_angle_deg": true_angle,
        "found_mm": [found] * frames,
        "true_touches_mm": true,
    }


@pytest.fixture(scope="module")
def picture():
    rows = [
        row("idle", 0.0, 0.0, [], []),
        row("touch", 20.0, 20.0, PLACES, PLACES),
        row("bend", 30.0, 20.0, [], PLACES[:1]),
    ]
    return film.episode_film(rows, SensorDesign.reference())


@pytest.fixture(scope="module")
def tree(picture):
    return ElementTree.fromstring(picture)  # noqa: S314  of our own making


def moments(tree):
    """Groups of the moments, each seen in its own part of the film."""
    groups = tree.findall(f"{SPACE}g")
    for number, group in enumerate(groups):
        (seen,) = group.findall(f"{SPACE}animate")
        assert seen.get("values").split(";") == [str(int(k == number)) for k in range(len(groups))]
    return groups


def test_the_film_is_one_picture_without_scripts_or_references(picture):
    assert b"<script" not in picture
    assert b"href" not in picture


def test_all_that_moves_has_a_value_for_every_moment(tree):
    for each in tree.iter(f"{SPACE}animate"):
        closing = each.get("calcMode") == "linear"  # back to where it began
        values = each.get("values").split(";")
        assert len(values) == 6 + closing
        assert not closing or values[0] == values[-1]


def test_discs_are_the_estimated_touches_and_rings_the_true_ones(tree):
    counts = []
    for group in moments(tree):
        ellipses = group.findall(f"{SPACE}ellipse")
        discs, rings = (
            [e for e in ellipses if (e.get("fill") == "none") == ring] for ring in (0, 1)
        )
        counts.append((len(discs), len(rings)))
        for disc, ring in zip(discs, rings, strict=False):  # both true, on the same bend
            assert (disc.get("cx"), disc.get("cy")) == (ring.get("cx"), ring.get("cy"))
    assert counts == [(0, 0), (0, 0), (2, 2), (2, 2), (0, 1), (0, 1)]


def test_the_sheet_is_seen_bent_as_far_as_it_is_estimated():
    sheet = film._View(SensorDesign.reference())

    def ends_below_the_middle(angle):
        left, middle, right = (sheet.line(angle, x, 0.03)[0] for x in (0.0, 0.075, 0.15))
        return (left + right)[1] / 2 - middle[1]

    assert ends_below_the_middle(0.0) == pytest.approx(0.0, abs=1e-9)
    # Plates of 55 mm, turned by 20 degrees, beyond 40 mm that bend.
    least = 0.055 * np.sin(np.radians(20.0)) * film.ENLARGED * np.cos(film.TILT)
    assert least < ends_below_the_middle(40.0) < 1.3 * least
    assert ends_below_the_middle(-10.0) < 0.0


def test_where_nothing_moves_the_fullest_moment_is_shown(tree):
    shown = [group.get("opacity") for group in moments(tree)]
    assert shown == ["0", "0", "0", "1", "0", "0"]
