"""A solved image drawn: detections, matched stars with their names and magnitudes, residuals enlarged."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..imaging import Image
from ..sensors.star_tracker import StarSolution
from ..stars.catalog import Catalog

SIDE = 1600
"""Longest side of the drawing, px."""
ENLARGED = 20.0
"""Residuals are drawn so many times longer."""
FOUND, MATCHED, WRONG = (250, 190, 60), (90, 220, 130), (255, 90, 90)


def draw(image: Image, found: StarSolution, catalog: Catalog, path: Path) -> Path:
    """Write a PNG and return its path: circles for detections, green with HIP number and magnitude for matched stars of the
    catalogue that they were found in."""
    from PIL import Image as Picture
    from PIL import ImageDraw

    scale = min(SIDE / max(image.width, image.height), 4.0)
    size = (max(round(image.width * scale), 1), max(round(image.height * scale), 1))
    picture = Picture.fromarray(_stretched(image.array)).resize(size).convert("RGB")
    pen = ImageDraw.Draw(picture)
    place = lambda xy: ((xy[0] + 0.5) * scale, (xy[1] + 0.5) * scale)
    for xy in found.centroids.xy_px:
        x, y = place(xy)
        pen.ellipse((x - 7, y - 7, x + 7, y + 7), outline=FOUND)
    i = found.identification
    for k, star, hip, residual in zip(i.detections, i.stars, i.hip, i.residuals_px, strict=True):
        x, y = place(found.centroids.xy_px[k])
        pen.ellipse((x - 11, y - 11, x + 11, y + 11), outline=MATCHED, width=2)
        pen.text((x + 13, y - 6), f"{f'HIP {hip}  ' if hip else ''}{catalog.magnitude[star]:.1f}", fill=MATCHED)
        dx, dy = residual * ENLARGED * scale
        pen.line((x, y, x + dx, y + dy), fill=WRONG, width=2)
    text = found.status
    if found.solved:
        text = f"RA {found.ra_deg:.4f}  Dec {found.dec_deg:+.4f}  roll {found.roll_deg:.3f} deg   {len(i.stars)} stars"
    pen.text((8, 8), f"{text}   residuals x {ENLARGED:.0f}", fill=(255, 255, 255))
    path.parent.mkdir(parents=True, exist_ok=True)
    picture.save(path)
    return path


def draw_residuals(
    path: Path, size: tuple[int, int], before: tuple[np.ndarray, np.ndarray], after: tuple[np.ndarray, np.ndarray]
) -> Path:
    """Write a PNG of a calibration and return its path: residual vectors over the field with the camera that it started from and
    with the fitted one, each panel with its own scale and a bar. size: of the image, px; places and residuals (n, 2), px."""
    from PIL import Image as Picture
    from PIL import ImageDraw

    scale = 760.0 / max(size)
    width, height = round(size[0] * scale), round(size[1] * scale)
    picture = Picture.new("RGB", (2 * width + 60, height + 80), (16, 18, 24))
    pen = ImageDraw.Draw(picture)
    for n, (name, (xy, residual)) in enumerate((("before", before), ("after", after))):
        left, top = 20 + n * (width + 20), 40
        length = np.hypot(residual[:, 0], residual[:, 1])
        longest = max(float(np.percentile(length, 90)), 1e-6) if len(length) else 1.0
        enlarged = 30.0 / longest
        panel = Picture.new("RGB", (width, height), (16, 18, 24))
        lines = ImageDraw.Draw(panel)
        for (x, y), (dx, dy) in zip((xy + 0.5) * scale, residual * enlarged):
            lines.ellipse((x - 1.5, y - 1.5, x + 1.5, y + 1.5), fill=FOUND)
            lines.line((x, y, x + dx, y + dy), fill=MATCHED if n else WRONG)
        lines.rectangle((0, 0, width - 1, height - 1), outline=(90, 96, 110))
        picture.paste(panel, (left, top))
        rms = float(np.sqrt(np.mean(residual**2))) if len(length) else 0.0
        pen.text((left, 16), f"{name}: {rms:.3g} px rms per axis, {len(xy)} stars", fill=(255, 255, 255))
        step = 10.0 ** np.floor(np.log10(longest))
        bar = step * max(k for k in (1, 2, 5) if k * step <= longest * 1.001)
        reach = left + bar * enlarged
        pen.line((left, top + height + 16, reach, top + height + 16), fill=(255, 255, 255), width=2)
        pen.text((reach + 8, top + height + 10), f"{bar:.3g} px", fill=(255, 255, 255))
    path.parent.mkdir(parents=True, exist_ok=True)
    picture.save(path)
    return path


def _stretched(array: np.ndarray) -> np.ndarray:
    """8 bits, from the median to the 99.9th percentile, so that faint stars show."""
    sample = array[:: max(array.shape[0] // 512, 1), :: max(array.shape[1] // 512, 1)]
    low, high = np.percentile(sample, [50.0, 99.9])
    high = max(float(high), float(low) + 1.0)
    return (255.0 * np.clip((array - low) / (high - low), 0.0, 1.0) ** 0.5).astype(np.uint8)
