"""Star sensor heads in a simulation: mounting, field, pinhole, and which catalogue stars they see.

Pinhole with focal length f (Zhou, Li and Wu 2021, (3)): a star in direction m in the head's axes S (z is the boresight) is seen
at p with m = [-p_x, -p_y, f] / norm; in body axes b = C_BS m.

The pinhole is exact here: noise is none of the image's but is put on the directions, as in the paper's b = C_bi r + eps (5), so
directions go through the image plane and come back as they were.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

Choice = Literal["central", "widest_pair"]
CHUNK = 512
"""Attitudes looked at together: bounds the memory of attitudes times stars."""


@dataclass(frozen=True)
class Head:
    """R_BS (3, 3): mounting, from the head's axes to the body's. field: full circular field of view, rad.

    choice: the star nearest to the boresight, or the pair of stars that is widest apart.
    """

    R_BS: np.ndarray
    field: float
    choice: Choice = "central"

    @property
    def stars(self) -> int:
        """How many directions it gives."""
        return 1 if self.choice == "central" else 2


def mounted(boresight_B: np.ndarray) -> np.ndarray:
    """R_BS (3, 3) with the boresight along a direction in B; the turn about it is chosen freely."""
    z = np.asarray(boresight_B, float) / np.linalg.norm(boresight_B)
    helper = np.eye(3)[int(np.argmin(np.abs(z)))]
    x = np.cross(helper, z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


def image_points(m_S: np.ndarray, focal: float) -> np.ndarray:
    """Image points p (..., 2), in the unit of `focal`, of directions (..., 3) in S. NaN behind the lens."""
    m = np.asarray(m_S, float)
    z = np.where(m[..., 2:] > 0.0, m[..., 2:], np.nan)
    return -focal * m[..., :2] / z


def directions_S(p: np.ndarray, focal: float) -> np.ndarray:
    """Directions m (..., 3) in S of image points (..., 2): [-p_x, -p_y, f] / norm (3)."""
    p = np.asarray(p, float)
    m = np.concatenate([-p, np.full((*p.shape[:-1], 1), focal)], axis=-1)
    return m / np.linalg.norm(m, axis=-1, keepdims=True)


def through_heads(R_BN: np.ndarray, heads: tuple[Head, ...], r_N: np.ndarray) -> np.ndarray:
    """Directions b (n, k, 3) in B of the stars r_N (n, k, 3) that `visible_stars` chose: through each head's image plane and
    mounting, b = C_BS m (3). Without noise, which is added to them as in (5)."""
    out, i = [], 0
    for head in heads:
        R_SN = head.R_BS.T @ R_BN
        m = directions_S(image_points(np.einsum("nij,nkj->nki", R_SN, r_N[:, i : i + head.stars]), 1.0), 1.0)
        out.append(m @ head.R_BS.T)
        i += head.stars
    return np.concatenate(out, axis=1)


def visible_stars(R_BN: np.ndarray, heads: tuple[Head, ...], catalogue_N: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Directions in N (n, k, 3) of the stars that the heads give at each attitude R_BN (n, 3, 3), and the mask (n, k) of
    those that are there; k is the sum of the heads' numbers. Of an absent star the direction is the boresight."""
    chosen, there = [], []
    for head in heads:
        bore = np.einsum("nij,i->nj", R_BN, head.R_BS[:, 2])
        r, ok = _of_head(bore, head, catalogue_N)
        chosen.append(r)
        there.append(ok)
    return np.concatenate(chosen, axis=1), np.concatenate(there, axis=1)


def _of_head(bore: np.ndarray, head: Head, stars: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    limit = np.cos(0.5 * head.field)
    r = np.repeat(bore[:, None], head.stars, axis=1)
    ok = np.zeros((len(bore), head.stars), dtype=bool)
    for a in range(0, len(bore), CHUNK):
        cosine = bore[a : a + CHUNK] @ stars.T
        if head.choice == "central":
            best = np.argmax(cosine, axis=1)
            seen = cosine[np.arange(len(best)), best] >= limit
            ok[a : a + CHUNK, 0] = seen
            r[a : a + CHUNK, 0][seen] = stars[best[seen]]
            continue
        for i, row in enumerate(cosine >= limit):
            near = stars[row]
            if len(near) > 1:
                first, second = np.unravel_index(np.argmin(near @ near.T), (len(near), len(near)))
                r[a + i, 0], r[a + i, 1], ok[a + i] = near[first], near[second], True
    return r, ok
