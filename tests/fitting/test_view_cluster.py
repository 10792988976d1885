"""A fit whose views are divided among workers: the fit of one process, up to rounding."""

import os
import pickle
import signal
from importlib.util import find_spec
from types import SimpleNamespace

import numpy as np
import pytest

import lingo_mi as lm
from helpers.dask_cluster import cluster as dask_cluster
from helpers.effect_parts import detector, tube
from helpers.fits import SHORT, geometry, tiny_scan
from lingo_mi.common.errors import InputError
from lingo_mi.effects.focal_spot import FocalSpot
from lingo_mi.effects.forward import Effects
from lingo_mi.fitting import step
from lingo_mi.fitting.loop import run
from lingo_mi.fitting.methods.by_name import METHODS
from lingo_mi.scan import Scan

physics = pytest.mark.skipif(
    any(find_spec(m) is None for m in ('spekpy', 'xraylib')), reason="needs pip install 'lingo_mi[physics]'"
)
SPOT = FocalSpot((12.0, 8.0), 2)
TWO = SHORT.changed(batch=2, iterations=3)


@pytest.fixture(scope='module')
def scan():
    return tiny_scan(geometry(4))


class Copies:
    """`jobs.actors.Actors` with two workers, which are copies in this process; keeps what they were asked for."""

    parts = ()

    def __init__(self, cluster, original):
        self.copies = [pickle.loads(pickle.dumps(original)) for _ in range(2)]
        Copies.parts = []

    def divided(self, method, items, *arguments):
        parts = [list(items)[i::2] for i in range(2)]
        Copies.parts += [part for part in parts if part]
        return [getattr(c, method)(part, *arguments) for c, part in zip(self.copies, parts) if part]


def stand_in(*addresses):
    return SimpleNamespace(client=SimpleNamespace(nthreads=lambda: dict.fromkeys(addresses, 1)))


@pytest.fixture
def two_workers(monkeypatch):
    monkeypatch.setattr(step, 'Actors', Copies)
    return stand_in('tcp://10.0.0.1:1', 'tcp://10.0.0.2:1')


def require_close(actual, wanted):
    """Compare fits by Adam's first moments, which are sums of the steps' gradients.

    Adam divides by the root of a mean square. A gradient of rounding alone, such as by the rotation of a sphere, therefore
    causes a whole step. Sums of float32 differ in the sixth digit of the largest value, because they are added in any order.
    """
    for name, values in wanted.state.first.items():
        np.testing.assert_allclose(actual.state.first[name], values, atol=3e-5 * np.abs(values).max(), err_msg=name)
    for name in 'gradient', 'visits':
        np.testing.assert_allclose(getattr(actual.state, name), getattr(wanted.state, name), rtol=1e-4, atol=1e-7)
    np.testing.assert_allclose(actual.history[-1]['loss'], wanted.history[-1]['loss'], rtol=1e-5)
    wanted_images = wanted.render(wanted.nominal_geometry)
    images = actual.render(wanted.nominal_geometry)
    np.testing.assert_allclose(images, wanted_images, atol=1e-5 * wanted_images.max())


def test_the_fit_of_one_process(scan, two_workers):
    """Two views are on one worker and one on the other, also after a densification."""
    method = SHORT.changed(
        batch=3, iterations=4, loss_scale='dynamic', densify_from=0, densify_every=2, densify_threshold=5e-3
    )
    actual, wanted = run(scan, method, cluster=two_workers), run(scan, method)
    assert len(actual.state) == len(wanted.state) > 60
    assert [len(part) for part in Copies.parts] == [2, 1] * 4
    require_close(actual, wanted)


def test_opacities(scan, two_workers):
    """The one process must add both views' derivatives by the opacities, which are pixels' inputs as they are."""
    method = METHODS['3dgs'].changed(batch=2, iterations=2, n_points=50)
    require_close(run(scan, method, cluster=two_workers), run(scan, method))


@pytest.mark.thorough
@pytest.mark.parametrize(
    'effects', [lambda: Effects(None, SPOT, detector(psf=8.0)), pytest.param(lambda: Effects(tube()), marks=physics)]
)
def test_modelled_effects(scan, two_workers, effects):
    """The effects travel with the scan."""
    seen = Scan(scan.geometry, scan.projections / 50, effects=effects())
    require_close(run(seen, TWO, cluster=two_workers), run(seen, TWO))


def test_what_workers_cannot_do(scan, two_workers):
    def refused(words, method, **options):
        with pytest.raises(InputError, match=words):
            lm.fit(scan, method, progress=False, **options)

    refused('a step has 1 view: set batch=N', SHORT, cluster='local:2')
    refused('write local:N', TWO, cluster='local:0')
    for options in dict(rate_pose=(1e-3, 1e-3)), dict(fit_air='view'):
        with pytest.raises(InputError, match='workers, which cannot fit poses, air levels'):
            run(scan, TWO.changed(**options), cluster=two_workers)
    with pytest.raises(InputError, match='fit of Gaussians among workers, but naf has none'):
        run(scan, METHODS['naf'].changed(batch=2), cluster=two_workers)
    with pytest.raises(InputError, match='threads of this process, which share one Dr.Jit: start processes'):
        run(scan, TWO, cluster=stand_in('inproc://10.0.0.1/1/2'))


@pytest.mark.thorough
def test_a_worker_is_killed(scan, tmp_path):
    """One of two real workers dies in the middle of a fit. A start that the workers do not have is refused."""
    method = TWO.changed(start='masks', n_points=60, iterations=6)
    with dask_cluster(tmp_path, workers=2) as (address, processes):
        numbers = list(processes().values())

        def kill(done, **_):
            if done == 3:
                os.kill(numbers[0], signal.SIGKILL)

        with pytest.raises(InputError, match="^worker tcp://.*: No module named 'helpers'; install it there, too"):
            lm.fit(scan, TWO, cluster=address, progress=False)
        actual = lm.fit(scan, method, cluster=address, progress=kill)
        assert len(processes()) == 1
        require_close(actual, lm.fit(scan, method, progress=False))
