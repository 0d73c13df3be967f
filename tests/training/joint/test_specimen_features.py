"""Specimen features: principal components of flat resistances."""

import numpy as np
import pytest

from eitskin.geometry import SensorDesign
from eitskin.simulator import Protocol
from eitskin.training.joint.combinations import (
    ANGLE_FEATURES,
    CLIP_SIGMA,
    RESPONSE_FEATURES,
    SpecimenFeatures,
)
from eitskin.training.method.input_spec import mirrors

IMAGES = mirrors(SensorDesign.reference(), Protocol.pairwise(8))
TRIVIAL = IMAGES[:1]
MIDDLE = np.linspace(300.0, 900.0, 28)


def specimens(count, rng, directions=28, spread=0.02):
    """Flat magnitudes (count, 28) [ohm] that differ along some directions and by a factor."""
    ways = rng.standard_normal((directions, 28)) * spread
    common = rng.uniform(0.5, 2.0, (count, 1))
    return MIDDLE * common * np.exp(rng.standard_normal((count, directions)) @ ways)


@pytest.fixture
def rng():
    return np.random.default_rng(3)


def test_common_factor_does_not_matter(rng):
    flat = specimens(50, rng)
    features = SpecimenFeatures.fit(flat, IMAGES)
    np.testing.assert_allclose(features.apply(3.0 * flat), features.apply(flat), atol=1e-9)
    scaled = SpecimenFeatures.fit(flat * rng.uniform(0.2, 5.0, (50, 1)), IMAGES)
    np.testing.assert_allclose(scaled.apply(flat), features.apply(flat), atol=1e-9)


def test_features_are_uncorrelated_and_of_variance_one(rng):
    """Unit variance over the specimens and their mirror images."""
    flat = specimens(120, rng)
    features = SpecimenFeatures.fit(flat, IMAGES)
    said = np.concatenate([features.apply(flat[:, mirror.order]) for mirror in IMAGES])
    assert said.shape == (480, ANGLE_FEATURES)
    np.testing.assert_allclose(said.mean(axis=0), 0.0, atol=1e-9)
    np.testing.assert_allclose(said.T @ said / 480, np.eye(ANGLE_FEATURES), atol=1e-9)


def test_the_first_features_are_those_of_an_analysis_of_fewer(rng):
    flat = specimens(200, rng)
    few, every = SpecimenFeatures.fit(flat, IMAGES, 5), SpecimenFeatures.fit(flat, IMAGES)
    assert len(every.directions) == ANGLE_FEATURES
    np.testing.assert_array_equal(every.first(5).apply(flat), few.apply(flat))
    assert every.first().apply(flat).shape == (200, RESPONSE_FEATURES)


def test_mirrors_make_specimens(rng):
    """The mean is mirror symmetric, though no specimen is."""
    flat = specimens(10, rng)
    features = SpecimenFeatures.fit(flat, IMAGES)
    for mirror in IMAGES:
        np.testing.assert_allclose(features.middle[mirror.order], features.middle, atol=1e-12)
    alone = SpecimenFeatures.fit(flat, TRIVIAL)
    assert not np.allclose(alone.middle[IMAGES[1].order], alone.middle, atol=1e-3)


def test_largest_differences_come_first(rng):
    """The directions of largest variance are found in noisy channels."""
    way = np.zeros(28)
    way[:4] = [0.5, -0.5, 0.5, -0.5]
    strength = rng.standard_normal(40)
    noise = 1e-3 * rng.standard_normal((40, 28))
    features = SpecimenFeatures.fit(
        MIDDLE * np.exp(0.05 * np.outer(strength, way) + noise), TRIVIAL
    )
    said = features.apply(MIDDLE * np.exp(0.05 * np.outer(strength, way)))
    assert abs(np.corrcoef(said[:, 0], strength)[0, 1]) > 0.999
    assert said[:, 0].std() == pytest.approx(1.0, rel=0.15)


def test_bad_channel_says_nothing(rng):
    """A missing channel at its mean value leaves the features unchanged."""
    flat = specimens(50, rng)
    features = SpecimenFeatures.fit(flat, TRIVIAL)
    ordinary = np.exp(features.middle) * 500.0
    way = np.where(np.arange(28) % 2, 0.1, -0.1)
    way[-2:] = 0.0  # both without: the mean of the others remains
    bad = ordinary * np.exp(way)
    said = features.apply(bad)
    bad[-2:] = np.nan
    np.testing.assert_allclose(features.apply(bad), said, atol=1e-9)
    assert np.abs(said).max() > 0.1
    ordinary[27] = np.nan
    np.testing.assert_allclose(features.apply(ordinary), 0.0, atol=1e-9)


@pytest.mark.parametrize(("count", "kept"), [(2, 0), (4, 0), (5, 1), (14, 2), (40, 8), (300, 20)])
def test_few_specimens_have_few_features(rng, count, kept):
    features = SpecimenFeatures.fit(specimens(count, rng), IMAGES)
    assert features.directions.shape == (kept, 28)
    assert features.apply(specimens(3, rng)).shape == (3, kept)


def test_specimens_that_are_all_the_same_have_none(rng):
    features = SpecimenFeatures.fit(np.tile(MIDDLE, (50, 1)), TRIVIAL)
    assert features.apply(MIDDLE).shape == (0,)
    two = SpecimenFeatures.fit(specimens(50, rng, directions=2), TRIVIAL)
    assert len(two.directions) == 2


def test_bounded_features_are_those_of_a_specimen_at_the_bound(rng):
    features = SpecimenFeatures.fit(specimens(50, rng), IMAGES)
    near = specimens(1, rng)[0]
    np.testing.assert_array_equal(features.bounded(near), features.apply(near))
    far = np.exp(features.middle + 12.0 * np.linalg.pinv(features.directions)[:, 0])
    assert features.apply(far)[0] == pytest.approx(12.0)
    assert features.bounded(far)[0] == CLIP_SIGMA
