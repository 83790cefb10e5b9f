"""What units of data sheets are in SI: a value times its unit is SI."""

from __future__ import annotations

import math

DEG = math.pi / 180.0
ARCSEC = DEG / 3600.0
HOUR_S = 3600.0
