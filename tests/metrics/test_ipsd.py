"""IPSD, against the paper's equation written as loops."""

import numpy as np

from lingo_mi.metrics.ipsd import ipsd, reverse_distance


def test_ipsd():
    rng = np.random.default_rng(0)
    p, t = rng.random((30, 3)), rng.random((20, 3))
    literal = sum(min(np.linalg.norm(a - b) for b in t) for a in p) / len(p)
    assert abs(ipsd(p, t) - literal) < 1e-12
    reverse = sum(min(np.linalg.norm(a - b) for a in p) for b in t) / len(t)
    assert abs(reverse_distance(p, t) - reverse) < 1e-12
    assert np.isnan(ipsd(p, np.zeros((0, 3)))) and np.isnan(ipsd(np.zeros((0, 3)), t))
