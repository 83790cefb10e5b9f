"""What a fitted lens leaves of the residuals that neighbouring stars share.

Noise of centroids averages out over stars. What a lens does beyond its model (a scanned photograph, refraction in air, a tilted
sensor) moves neighbours alike and does not: attitudes are off by it whatever the number of stars.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from .calibrate import Calibration, Matches, derivative

ORDERS = (4, 3, 2)
"""Of the polynomial that displaces pixels, the first that leaves `SPARE` coordinates for each of its terms."""
SPARE = 4


def shared_px(frames: Sequence[Matches], fit: Calibration) -> float:
    """Displacement, px, root mean square of an axis, that a smooth field explains of the residuals beyond the lens.

    A polynomial in column and row is fitted to all frames' residuals together with the lens and the attitudes. What it takes
    from the sum of squares beyond its number of terms (as chance would let it take) is displacement. 0 where that is nothing, or
    the stars are too few to tell.
    """
    camera, names = fit.camera, fit.names
    xy, sigma, error, lens, spans = [], [], [], [], []
    for m, q, kept in zip(frames, fit.q_SN, fit.kept):
        d = m.directions_N[kept] @ _matrix(q).T
        s = np.full(len(m.xy_px), 0.1) if m.sigma_px is None else m.sigma_px
        # Where stars are predicted: a field of the places that were measured would explain their errors by themselves.
        xy.append(camera.pixels(d))
        sigma.append(s[kept])
        error.append(m.xy_px[kept] - xy[-1])
        both = derivative(camera, names, d, turns=True)
        lens.append(both[:, :, : len(names)])
        turns = both[:, :, len(names) :] / s[kept, None, None]
        spans.append(np.linalg.qr(turns.reshape(-1, 3))[0])
    weight = [np.repeat(1.0 / s, 2) for s in sigma]
    y = _beside([(e.ravel() * w)[:, None] for e, w in zip(error, weight)], spans)[:, 0]
    A = _beside([b.reshape(2 * len(b), len(names)) * w[:, None] for b, w in zip(lens, weight)], spans)
    left = len(y) - 3 * len(spans)
    before, rank = _leftover(A, y)
    for order in ORDERS:
        field = [_polynomial(camera, at, order).reshape(2 * len(at), -1) * w[:, None] for at, w in zip(xy, weight)]
        after, all_terms = _leftover(np.concatenate([A, _beside(field, spans)], axis=1), y)
        terms = all_terms - rank
        if left - all_terms >= SPARE * terms:
            excess = before - after * (1.0 + terms / (left - all_terms))
            return float(np.sqrt(max(excess, 0.0) / sum(float((w * w).sum()) for w in weight)))
    return 0.0


def _beside(parts: list[np.ndarray], spans: list[np.ndarray]) -> np.ndarray:
    """Rows of all frames, without what each frame's own turn explains."""
    return np.concatenate([A - Q @ (Q.T @ A) for A, Q in zip(parts, spans)])


def _leftover(A: np.ndarray, y: np.ndarray) -> tuple[float, int]:
    """Sum of squares that the columns of A leave of y, and their rank."""
    size = np.linalg.norm(A, axis=0)
    U, s, _ = np.linalg.svd(A / np.where(size > 0.0, size, 1.0), full_matrices=False)
    U = U[:, s > 1e-7 * s[0]] if len(s) else U
    return float(y @ y - np.square(U.T @ y).sum()), U.shape[1]


def _polynomial(camera, xy: np.ndarray, order: int) -> np.ndarray:
    """Displacements (n, 2, terms) at pixels (n, 2): products of Legendre's polynomials over the image, for column and for row."""
    from numpy.polynomial.legendre import legvander2d

    u, v = (2.0 * (xy + 0.5) / [camera.width, camera.height] - 1.0).T
    total = np.add.outer(np.arange(order + 1), np.arange(order + 1)).ravel()
    one = legvander2d(u, v, [order, order])[:, total <= order]
    zero = np.zeros_like(one)
    return np.stack([np.concatenate([one, zero], axis=1), np.concatenate([zero, one], axis=1)], axis=1)


def _matrix(q: np.ndarray) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    return Rotation.from_quat(q).as_matrix()


__all__ = ["shared_px"]
