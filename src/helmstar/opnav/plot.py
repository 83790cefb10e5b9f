"""A frame drawn: the body enlarged, its limb as measured and as fitted, brightness centroid and centre of figure."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ..imaging import Image
from ..imaging.body import Ellipsoid, FigureCentre

SIDE = 900
LIMB, OUTLINE, CENTROID, CENTRE, TEXT = (90, 200, 255), (90, 220, 130), (250, 190, 60), (255, 90, 90), (255, 255, 255)


def draw(image: Image, scene: Any, found: FigureCentre, path: Path) -> Path:
    """Write a PNG and return its path. scene: (Scene, Trial) of the centre, or None where there is none."""
    from PIL import Image as Picture
    from PIL import ImageDraw

    known = found.centre_px if found.usable else found.centroid_px
    if np.isfinite(known).all():
        half = max(0.75 * found.diameter_px * max(found.size, 0.5), 10.0)
        low = np.floor(known - half).astype(int)
        size = int(2 * half) + 2
    else:
        low, size = np.zeros(2, int), max(image.width, image.height)
    x0, y0 = max(int(low[0]), 0), max(int(low[1]), 0)
    x1, y1 = min(int(low[0]) + size, image.width), min(int(low[1]) + size, image.height)
    if x1 <= x0 or y1 <= y0:
        x0, y0, x1, y1 = 0, 0, image.width, image.height
    part = np.asarray(image.array[y0:y1, x0:x1], float)
    dark, bright = np.percentile(part, [5.0, 99.8])
    grey = 255.0 * np.clip((part - dark) / max(bright - dark, 1e-9), 0.0, 1.0) ** 0.7
    scale = SIDE / max(x1 - x0, y1 - y0)
    shape = (max(round((x1 - x0) * scale), 1), max(round((y1 - y0) * scale), 1))
    picture = Picture.fromarray(grey.astype(np.uint8)).resize(shape, Picture.Resampling.NEAREST).convert("RGB")
    pen = ImageDraw.Draw(picture)
    place = lambda xy: ((xy[0] - x0 + 0.5) * scale, (xy[1] - y0 + 0.5) * scale)
    if scene is not None and isinstance(scene[0].target.shape, Ellipsoid):
        from ..imaging.body.limb import outline_px

        rim = outline_px(scene[0], scene[1], np.linspace(0.0, 2.0 * np.pi, 181))
        pen.line([place(p) for p in rim], fill=OUTLINE, width=2)
    for p in found.limb_px:
        x, y = place(p)
        pen.ellipse((x - 2, y - 2, x + 2, y + 2), fill=LIMB)
    if np.isfinite(found.centroid_px).all():
        x, y = place(found.centroid_px)
        pen.line((x - 9, y - 9, x + 9, y + 9), fill=CENTROID, width=2)
        pen.line((x - 9, y + 9, x + 9, y - 9), fill=CENTROID, width=2)
    if found.usable:
        x, y = place(found.centre_px)
        pen.line((x - 12, y, x + 12, y), fill=CENTRE, width=2)
        pen.line((x, y - 12, x, y + 12), fill=CENTRE, width=2)
    text = f"{found.status}: {found.message}" if found.message else found.status
    if found.usable:
        sx, sy = found.sigma_px
        text += f"\n{found.method}: {found.centre_px[0]:.3f} {found.centre_px[1]:.3f} px (+- {sx:.2g} {sy:.2g})"
    pen.multiline_text((8, 8), text, fill=TEXT)
    legend = (
        ("centre of figure", CENTRE),
        ("brightness centroid", CENTROID),
        ("outline of the figure", OUTLINE),
        *([("limb", LIMB)] if len(found.limb_px) else []),
    )
    for k, (name, colour) in enumerate(legend):
        pen.text((8, shape[1] - 16 * (len(legend) - k) - 4), name, fill=colour)
    path.parent.mkdir(parents=True, exist_ok=True)
    picture.save(path)
    return path


__all__ = ["draw"]
