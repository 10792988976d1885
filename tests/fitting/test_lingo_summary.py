"""The line of a fit about the parts of LINGO."""

from __future__ import annotations

import re

import numpy as np
import pytest

import lingo_mi as lm
from lingo_mi.fitting.lingo_summary import lingo_summary
from lingo_mi.fitting.loop import run
from lingo_mi.fitting.measure import summary
from lingo_mi.lingo.masks import masks
from lingo_mi.lingo.otsu import otsu


@pytest.fixture(scope='module')
def data():
    foot = lm.phantom('foot', size=16)
    geometry = lm.Geometry.cone(
        DSO=1000, DSD=1500, nDetector=(24, 24), dDetector=20, grid=foot.grid, angles=lm.circular(8)
    )
    return lm.simulate(foot, geometry, views=6)


def few(method):
    return method.changed(iterations=3, n_points=200)


def test_of_the_default(data):
    fit = run(data.train, few(lm.Fast()), seed=0)
    text = lingo_summary(fit)
    numbers = re.fullmatch(r'masks at (\S+) and (\S+) keep (\S+) of 4,096 voxels; loss scale (\S+) to (\S+)', text)
    high, low, cells, least, most = (float(x.replace(',', '')) for x in numbers.groups())
    thresholds = masks(data.train.projections).t_high  # line integrals, as measured
    assert high == pytest.approx(thresholds.mean(), rel=0.01) and low == pytest.approx(0.1 * high, rel=0.01)
    assert 0 < cells < 4096 and cells == fit.info['cells_low']
    t = np.array([otsu(image) for image in fit.render()]) * data.train.geometry.grid.scale / fit.model.unit
    factor = t + 0.25 / t
    assert (least, most) == (pytest.approx(factor.min(), rel=0.01), pytest.approx(factor.max(), rel=0.01))
    assert f'LINGO           {text}' in summary(fit.with_data(data).numbers).splitlines()


def test_of_the_published_method(data):
    text = lingo_summary(run(data.train, few(lm.LINGO()), seed=0))
    assert re.search(r'of \S+ voxels, voxel scaling S = \d', text) and 'loss scale' in text
    alone = lingo_summary(run(data.train, few(lm.LINGO()).changed(loss_scale='statistic'), seed=0))
    assert alone.endswith('on the densification alone')
    assert 'loss' not in lingo_summary(run(data.train, few(lm.LINGO()).changed(loss_scale='none'), seed=0))


def test_of_masks_that_are_not_used(data):
    projections = data.train.projections.copy()
    projections[2] = 0
    fit = run(lm.Scan(data.train.geometry, projections), few(lm.Fast()), seed=0)
    assert lingo_summary(fit).startswith('masks not used, since they would cut off 100% of the edges; loss scale')


@pytest.mark.parametrize('method', [lm.R2(), lm.GaussianSplatting()])
def test_of_others(data, method):
    assert lingo_summary(run(data.train, few(method), seed=0)) is None
