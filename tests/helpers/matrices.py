"""What tests share with joseph."""

import numpy as np


def matrix(geometry) -> np.ndarray:
    """Joseph's matrix, dense, [view * v * u, x * y * z], ray by ray and slice by slice in float64."""
    frames, size, voxel = geometry.rays(), np.array(geometry.nVoxel), np.array(geometry.dVoxel)
    first = np.array(geometry.offOrigin) + (voxel - geometry.sVoxel) / 2
    rows = []
    for view in range(len(geometry)):
        for v in range(geometry.nDetector[0]):
            for u in range(geometry.nDetector[1]):
                o, d = frames.through(view, u + 0.5, v + 0.5)
                weights = np.zeros(size)
                main = int(abs(d[1] / voxel[1]) > abs(d[0] / voxel[0]))
                for m in range(size[main]):
                    t = (first[main] + m * voxel[main] - o[main]) / d[main]
                    p = (o + t * d - first) / voxel
                    if (p < -0.5).any() or (p > size - 0.5).any():
                        continue
                    p = np.clip(p, 0, size - 1)
                    path = voxel[main] * np.linalg.norm(d) / abs(d[main])
                    hats = [np.maximum(1 - abs(np.arange(n) - x), 0) for n, x in zip(size, p)]
                    weights += path * hats[0][:, None, None] * hats[1][:, None] * hats[2]
                rows.append(weights.ravel())
    return np.array(rows)
