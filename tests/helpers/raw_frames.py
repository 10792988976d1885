"""Raw frames of a scanner, simulated from known line integrals: gain, dark counts, Poisson noise, dead and hot pixels."""

from dataclasses import dataclass

import numpy as np

import lingo_mi as lm


@dataclass
class Raw:
    """Line integrals [n, v, u] and the uint16 frames that a panel makes of them; `bad` [v, u] is dead or hot."""

    truth: np.ndarray
    views: np.ndarray
    flats: np.ndarray
    darks: np.ndarray
    bad: np.ndarray
    photons: float


def raw_frames(n=6, shape=(24, 40), photons=20_000.0, noise=True, exposure=1.0) -> Raw:
    """A ball that wanders; 1 count a photon, a gain of 20 % with stripes, 300 dark counts, 4 dead and 4 hot pixels."""
    rng = np.random.default_rng(3)
    radius = 0.375 * shape[0]
    v, u = np.mgrid[: shape[0], : shape[1]]
    centre = shape[1] / 2 + 4 * np.cos(2 * np.pi * np.arange(n) / n)
    distance = (u[None] + 0.5 - centre[:, None, None]) ** 2 + (v[None] + 0.5 - shape[0] / 2) ** 2
    truth = 2 * np.sqrt(np.maximum(radius**2 - distance, 0)) / radius
    gain = 1 + 0.1 * np.sin(u) + 0.1 * rng.uniform(-1, 1, shape)
    offset = 300 + rng.uniform(-5, 5, shape)
    bad = np.zeros(shape, bool)
    places = rng.permutation(shape[0] * shape[1])[:8]
    bad.flat[places] = True

    def take(mean, count):
        mean = np.broadcast_to(mean, (count, *shape))
        counts = (rng.poisson(mean) if noise else mean) + offset
        counts.reshape(count, -1)[:, places[:4]] = 300  # dead
        counts.reshape(count, -1)[:, places[4:]] = 40_000  # hot
        return np.clip(np.round(counts), 0, 65535).astype(np.uint16)

    flats, darks = take(photons * gain, 20), take(np.zeros(shape), 10)
    views = take(photons * gain * np.exp(-truth) * np.reshape(exposure, (-1, 1, 1)), n)
    return Raw(truth, views, flats, darks, bad, photons)


def load(frames, geometry, **options):
    return lm.load_raw(frames, geometry, progress=False, **options)


def save(tmp_path, raw):
    for name in ('views', 'flats', 'darks'):
        np.save(tmp_path / f'{name}.npy', getattr(raw, name))
    return dict(flats=tmp_path / 'flats.npy', darks=tmp_path / 'darks.npy')


def check(scan, raw):
    """Line integrals within five of their own standard deviations, the mask exactly the bad pixels."""
    valid = np.ones(scan.projections.shape, bool) if scan.valid is None else scan.valid
    np.testing.assert_array_equal(valid, np.broadcast_to(~raw.bad, valid.shape))
    sigma = np.sqrt(np.exp(raw.truth) / raw.photons * (1 + 1 / 20) * 1.3)
    assert (np.abs(scan.projections - raw.truth)[valid] < 5 * sigma[valid]).all()
    assert abs((scan.projections - raw.truth)[valid].mean()) < 1e-3
