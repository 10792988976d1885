"""The loss scale and Otsu's threshold on the device, against scikit-image."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from skimage.filters import threshold_otsu

from lingo_mi.lingo.loss_scale import loss_scale, otsu_on_device

RNG = np.random.default_rng(5)
HISTOGRAMS = dict(
    uniform=RNG.random(5000),
    dark=RNG.random(5000) ** 4,
    negative=RNG.normal(size=999),
    two_hills=np.concatenate([RNG.normal(1, 0.1, 3000), RNG.normal(5, 0.3, 2000)]),
    two_values=np.repeat([0.0, 7.0], [500, 3]),
    outlier=np.append(1e-3 * RNG.random(9000), 9),
    one_pixel=np.array([2.0]),
    mostly_empty=np.maximum(RNG.normal(size=(64, 64)), 0).ravel(),
)


@pytest.mark.parametrize('name', list(HISTOGRAMS))
def test_otsu_is_scikit_images(name):
    image = HISTOGRAMS[name].astype(np.float32)
    bin = float(np.ptp(image)) / 256
    assert otsu_on_device(mi.Float(image)).numpy()[0] == pytest.approx(
        threshold_otsu(image, nbins=256), abs=1.01 * bin + 1e-9
    )


@pytest.mark.parametrize('value', [0.0, 3.25, -1.0])
def test_otsu_of_a_flat_image_is_its_value(value):
    assert otsu_on_device(dr.full(mi.Float, value, 100)).numpy() == value


def test_loss_scale():
    image = HISTOGRAMS['two_hills'].astype(np.float32)
    threshold = threshold_otsu(image, nbins=256)
    assert loss_scale(mi.Float(image)).numpy() == pytest.approx(threshold + 0.25 / threshold, rel=1e-2)
    assert loss_scale(dr.zeros(mi.Float, 100)).numpy() == pytest.approx(25.01)
    x = mi.Float(image)
    dr.enable_grad(x)
    scale = loss_scale(x)
    assert dr.width(scale) == 1 and not dr.grad_enabled(scale)


def test_otsu_may_part_the_two_highest_bins():
    image = np.repeat(np.float32([254, 255]), 2**19)
    image[0] = 0
    assert otsu_on_device(mi.Float(image)).numpy()[0] == pytest.approx(threshold_otsu(image, nbins=256), abs=0.1)
