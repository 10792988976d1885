"""Alpha compositing against a literal float64 transcription of 3DGS's equations, and its derivatives against differences."""

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from lingo_mi.geometry import CircularGeometry, Grid
from lingo_mi.geometry.trajectories import circular
from lingo_mi.projectors.alpha import composite, flatten
from lingo_mi.projectors.view import View

NAMES = 'centre', 'scale', 'rotation', 'opacity', 'radiance'


def geometry(mode='cone'):
    return CircularGeometry(
        DSO=500.0,
        DSD=750.0,
        nDetector=(22, 37),
        dDetector=(18.0, 18.0),
        angles=circular(3, 360, start=20),
        mode=mode,
        offDetector=(7.0, -4.0),
        grid=Grid((32, 32, 32), (8.0, 8.0, 8.0)),
    )


def cloud(n=40, seed=0, opacity=(0.02, 0.95)):
    rng = np.random.default_rng(seed)
    q = rng.normal(size=(n, 4))
    return dict(
        centre=rng.uniform(-0.6, 0.6, (n, 3)),
        scale=np.exp(rng.uniform(-4, -1.5, (n, 3))),
        rotation=q / np.linalg.norm(q, axis=1, keepdims=True),
        opacity=rng.uniform(*opacity, n),
        radiance=rng.random(n),
    )


def on_device(c):
    kinds = dict(centre=mi.Point3f, scale=mi.Vector3f, rotation=mi.Vector4f)
    return [kinds[k](np.float32(c[k]).T) if k in kinds else mi.Float(np.float32(c[k])) for k in NAMES]


def matrix(q):
    x, y, z, w = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def literal(c, frames, height, width):
    """Equations 3 to 6 of Kerbl et al. and appendix C, pixel by pixel and Gaussian by Gaussian."""
    s, o, u, v = (np.asarray(getattr(frames, k)[0], float) for k in ('source', 'corner', 'u', 'v'))
    n = np.cross(u, v)
    n /= np.linalg.norm(n)
    n = n * np.sign(n @ (s if frames.parallel else o - s))
    basis = np.stack([u / (u @ u), v / (v @ v)])  # u and v are perpendicular
    flat = []
    for k in range(len(c['opacity'])):
        p = c['centre'][k]
        M = matrix(c['rotation'][k] / np.linalg.norm(c['rotation'][k])) * c['scale'][k]
        if frames.parallel:
            depth, slope = n @ (p - o), s / (n @ s)
            place, J = basis @ (p - o - slope * depth), basis @ (np.eye(3) - np.outer(slope, n))
        else:
            depth, far = n @ (p - s), n @ (o - s)
            place = basis @ (s + (p - s) * far / depth - o)
            J = basis @ (far / depth * (np.eye(3) - np.outer(p - s, n) / depth))  # derivative of place by p
        flat.append(
            (depth, place, np.linalg.inv(J @ M @ M.T @ J.T + 0.3 * np.eye(2)), c['opacity'][k], c['radiance'][k])
        )
    image = np.zeros((height, width))
    for y in range(height):
        for x in range(width):
            T = 1.0
            for _, place, inverse, opacity, radiance in sorted(flat, key=lambda f: f[0]):
                d = np.array([x + 0.5, y + 0.5]) - place
                alpha = min(0.99, opacity * np.exp(-0.5 * d @ inverse @ d))
                if alpha < 1 / 255:
                    continue
                if T * (1 - alpha) < 1e-4:
                    break
                image[y, x] += radiance * alpha * T
                T *= 1 - alpha
    return image


def render(c, view):
    return composite(flatten(*on_device(c), view), view.height, view.width).numpy().reshape(view.height, view.width)


@pytest.mark.parametrize('mode', ['cone', 'parallel'])
@pytest.mark.parametrize('opacity', [(0.02, 0.95), (0.98, 1.0)])
def test_values_are_those_of_the_equations(mode, opacity):
    g, c = geometry(mode), cloud(opacity=opacity)
    frames, (height, width) = g.normalised_rays(), g.nDetector
    image = render(c, View.of(frames, 0, height, width))
    truth = literal(c, frames, height, width)
    assert truth.max() > 0.3
    # A pixel on the brink of 1/255 may fall to either side.
    error = np.abs(image - truth)
    assert np.sort(error.ravel())[-3] < 2e-5 and error.max() < 1.1 / 255


@pytest.mark.parametrize('mode', ['cone', pytest.param('parallel', marks=pytest.mark.thorough)])
def test_derivatives_are_those_of_differences(mode):
    g, c = geometry(mode), cloud(12, 3, (0.1, 0.9))
    frames, (height, width) = g.normalised_rays(), g.nDetector
    view = View.of(frames, 0, height, width)
    weight = np.random.default_rng(1).normal(size=(height, width))
    arrays = on_device(c)
    dr.enable_grad(arrays)
    image = composite(flatten(*arrays, view), height, width)
    dr.backward(dr.sum(image * mi.Float(np.float32(weight.ravel()))))
    gradient = {n: np.array(dr.grad(a)).T.reshape(c[n].shape) for n, a in zip(NAMES, arrays)}
    rng = np.random.default_rng(2)
    for name in NAMES:
        wrong = 0
        for _ in range(3):
            direction = rng.normal(size=c[name].shape) * (c[name] if name == 'scale' else 1)
            h = 1e-6  # so small that hardly a pixel crosses 1/255, where the image jumps
            ends = [literal(c | {name: c[name] + s * h * direction}, frames, height, width) for s in (-1, 1)]
            change = (ends[1] - ends[0]) / (2 * h)
            change[np.abs(change) > 1e2] = 0
            slope = (change * weight).sum()
            wrong += abs((gradient[name] * direction).sum() - slope) > 2e-3 * np.linalg.norm(gradient[name] * direction)
        assert wrong == 0, name


@pytest.mark.parametrize('width', [8, 1, 37])
def test_one_gaussian_in_one_tile(width):
    """At the middle of a pixel, the image is its opacity times its radiance, with their derivatives."""
    c = {name: np.array([value]) for name, value in dict(opacity=0.5, radiance=0.7).items()}
    c |= dict(centre=np.zeros((1, 3)), scale=np.full((1, 3), 1e-3), rotation=np.array([[0, 0, 0, 1.0]]))
    g = replace(geometry('parallel'), nDetector=(1, width), offDetector=(0.0, 0.0 if width % 2 else 9.0))
    arrays = on_device(c)
    dr.enable_grad(arrays)
    image = composite(flatten(*arrays, View.of(g.normalised_rays(), 0, 1, width)), 1, width)
    assert image.numpy()[width // 2 - 1 + width % 2] == pytest.approx(0.35, rel=1e-5)
    dr.backward(dr.max(image))
    assert dr.grad(arrays[3])[0] == pytest.approx(0.7, rel=1e-5)
    assert dr.grad(arrays[4])[0] == pytest.approx(0.5, rel=1e-5)


def test_nothing_in_view_is_black():
    c = cloud(3)
    c['centre'] = c['centre'] + [0, 0, 50]
    view = View.of(geometry().normalised_rays(), 0, 22, 37)
    arrays = on_device(c)
    dr.enable_grad(arrays)
    image = composite(flatten(*arrays, view), 22, 37)
    dr.backward(dr.sum(image))
    assert not image.numpy().any() and not np.array(dr.grad(arrays[0])).any()


def test_results_repeat_to_the_bit(sums_in_order):
    view = View.of(geometry().normalised_rays(), 0, 22, 37)
    grads = []
    for _ in range(3):
        arrays = on_device(cloud(300, 5))
        dr.enable_grad(arrays)
        dr.backward(dr.sum(dr.square(composite(flatten(*arrays, view), 22, 37))))
        grads.append(np.array(dr.grad(arrays[1])))
    assert (grads[0] == grads[1]).all() and (grads[0] == grads[2]).all()
