"""What the command line takes: commands, options, help with examples. It imports nothing heavy, so that help is instant."""

from __future__ import annotations

import argparse
import sys
from typing import NoReturn

from . import __version__

EPILOG = """examples:
  helmstar scenarios                                  what can be run
  helmstar run xu2020                                 the full Monte Carlo campaign and its report
  helmstar run xu2020 --runs 20 --estimators lie,mekf --set star.sigma_arcsec=5
  helmstar attitude gyro.csv stars.csv --config sensors.toml
  helmstar allan gyro.csv                             noise of a gyro, ready for sensors.toml
  helmstar solve frame.png --fov 11.4                 attitude from an image of stars
  helmstar calibrate night/*.png --fov 11.4           camera from images of stars
  helmstar render --ra 83.8 --dec -5.4 --fov 12       such an image, with its truth

Every command has --help with an example. Documentation: README.md and docs/."""


class _Parser(argparse.ArgumentParser):
    """As argparse's, with an error's last line as every other error's. Subcommands' parsers are of this class too."""

    misuse = 2
    """Exit code of a wrong call."""

    def error(self, message: str) -> NoReturn:
        self.print_usage(sys.stderr)
        self.exit(self.misuse, f"error: {' '.join(message.splitlines())}\n")


def parser() -> argparse.ArgumentParser:
    """The whole command line."""
    raw = argparse.RawDescriptionHelpFormatter
    p = _Parser(
        prog="helmstar",
        description="Spacecraft attitude from stars and gyros: simulate, estimate, and prove how well.",
        epilog=EPILOG,
        formatter_class=raw,
    )
    p.add_argument("--version", action="version", version=f"helmstar {__version__}")
    sub = p.add_subparsers(dest="command", metavar="COMMAND", required=True)

    c = sub.add_parser(
        "run",
        help="run a scenario's Monte Carlo campaign and write its report",
        description="Run a scenario's Monte Carlo campaign: results.nc, summary.json and report.html in the output folder.",
        epilog="""examples:
  helmstar run xu2020
  helmstar run xu2020 --runs 20 --seed 7 --estimators lie,lie_tuned --out here
  helmstar run xu2020 --set star.sigma_arcsec=5 --set gyro.sigma_rad_step=3e-6 --json
  helmstar run mine.toml --resume                     go on after Ctrl-C""",
        formatter_class=raw,
    )
    c.add_argument("scenario", help="a name from `helmstar scenarios`, or a .toml file of your own")
    c.add_argument("--runs", type=int, metavar="N", help="number of Monte Carlo runs (default: the scenario's)")
    c.add_argument("--seed", type=int, metavar="S", help="seed of all random streams (default: the scenario's)")
    c.add_argument("--estimators", metavar="A,B", help="only these estimators (default: all)")
    c.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="override any key of the scenario; repeatable"
    )
    c.add_argument("--workers", type=int, metavar="W", help="blocks of runs computed side by side (default: cores)")
    c.add_argument(
        "--batch", type=int, metavar="N", help="runs a worker takes at a time, in whole blocks (default: one)"
    )
    c.add_argument("--dask", metavar="ADDRESS", help='compute on a Dask cluster (pip install "helmstar[dask]")')
    c.add_argument("--resume", action="store_true", help="go on with an interrupted campaign in the output folder")
    _common(c, "helmstar-out/SCENARIO-SEED")

    c = sub.add_parser(
        "scenarios",
        help="list the built-in scenarios, or print one as TOML",
        description="List the built-in scenarios with their estimators' keys, or print one to start your own file from.",
        epilog="""examples:
  helmstar scenarios
  helmstar scenarios xu2020 > mine.toml               edit it, then: helmstar run mine.toml""",
        formatter_class=raw,
    )
    c.add_argument("scenario", nargs="?", help="print this scenario's TOML")
    c.add_argument("--json", action="store_true", help="one JSON object on stdout")

    c = sub.add_parser(
        "attitude",
        help="attitude and gyro drift from telemetry: gyro rates and star-tracker attitudes or star directions",
        description="""Filter and smooth attitude and gyro drift (6 states) from CSV or Parquet telemetry.
Native columns: time_s; gyro_x_rad_s, gyro_y_rad_s, gyro_z_rad_s; q_bn_x, q_bn_y, q_bn_z, q_bn_w (scalar last, N to B).
They may stand in one table or in two; other layouts are mapped by [columns] in the configuration (docs/telemetry.md).
GRACE-FO Level-1 (SCA1A, SCA1B, IMU1A, IMU1B), CCSDS AEM, STK .a and SPICE CK files are read as they are. A folder of star
images with times (frames.csv, or dates in the images) stands for attitudes, with gyro data beside it or without.""",
        epilog="""examples:
  helmstar attitude telemetry.csv
  helmstar attitude SCA1B_2022-01-01_C_04.txt IMU1B_2022-01-01_C_04.txt
  helmstar attitude gyro.csv attitude.aem --aem --ck --out flight
  helmstar attitude gyro.csv startracker.parquet --config sensors.toml --out flight
  helmstar attitude gyro.csv stars.csv --config sensors.toml --json > summary.json
  helmstar attitude night --fov 11.4                  a folder of star images, no gyro
  helmstar attitude night gyro.csv --camera cam.toml --config sensors.toml""",
        formatter_class=raw,
    )
    c.add_argument(
        "files",
        nargs="+",
        metavar="FILE",
        help="CSV or Parquet tables, GRACE-FO, AEM, STK or CK files; a folder of frames",
    )
    c.add_argument("--fov", metavar="DEG", help="of a folder of frames: as of helmstar solve")
    c.add_argument("--camera", metavar="TOML", help="of a folder of frames: calibrated camera (docs/imaging.md)")
    c.add_argument("--pixel-aspect", type=float, default=1.0, metavar="R", help="of a folder of frames")
    c.add_argument(
        "--config", metavar="TOML", help="sensors.toml: columns, noise, mounting, gate (see docs/telemetry.md)"
    )
    c.add_argument("--strict", action="store_true", help="a bad row is an error instead of being dropped and reported")
    c.add_argument("--csv", action="store_true", help="write tables as CSV instead of Parquet")
    c.add_argument(
        "--aem", action="store_true", help="write the smoothed attitude as CCSDS AEM too: attitude.aem (needs dates)"
    )
    c.add_argument(
        "--ck",
        action="store_true",
        help='write it as SPICE CK too: attitude.bc with .tsc and .tls (pip install "helmstar[spice]")',
    )
    _common(c, "helmstar-out/attitude-FILE")

    c = sub.add_parser(
        "solve",
        help="attitude from images of stars, without a prior",
        description="""Find where images of stars look: right ascension, declination, roll, attitude with sigma, matched stars.
Images are PNG, JPEG, TIFF, BMP or FITS. A solution whose probability to be false is above --max-false is refused.
Exit code: 0 all solved, 2 some not, 1 misuse.""",
        epilog="""examples:
  helmstar solve frame.png --fov 11.4
  helmstar solve *.jpg --fov 5..25 --json
  helmstar solve frame.fits --camera cam.toml --time 2019-07-29T20:47:26 --plot drawn""",
        formatter_class=raw,
    )
    c.misuse = 1
    c.add_argument("files", nargs="+", metavar="IMAGE", help="images of stars")
    c.add_argument(
        "--fov", metavar="DEG", help="horizontal full field, within 1%%, 11.4, or a range, 5..25 (default: 4..30)"
    )
    c.add_argument("--camera", metavar="TOML", help="calibrated camera instead of a field (docs/imaging.md)")
    c.add_argument("--pixel-aspect", type=float, default=1.0, metavar="R", help="pixel height over width (default: 1)")
    c.add_argument(
        "--time", metavar="UTC", help="time of the images: moves the stars and adds aberration (default: J2000)"
    )
    c.add_argument(
        "--max-false", type=float, default=1e-5, metavar="P", help="largest probability to be false (default: 1e-5)"
    )
    c.add_argument(
        "--catalog", choices=("hipparcos", "gaia"), default="hipparcos",
        help='stars: Hipparcos to V 9, or Gaia to G 10 for narrow fields (pip install "helmstar[gaia]")',
    )  # fmt: skip
    c.add_argument("--plot", metavar="DIR", help="folder for a drawing of each image")
    c.add_argument("--json", action="store_true", help="one JSON object on stdout, progress on stderr")

    c = sub.add_parser(
        "render",
        help="a star tracker's frame of the sky, or a sequence, with its truth",
        description="""Render what a star tracker would see: stars of the catalogue with point spread, smear, Poisson and
read noise, dark current, hot pixels, glow. --ra, --dec, --roll are of the image's centre at mid-exposure, as
`helmstar solve` says them.""",
        epilog="""examples:
  helmstar render --ra 83.8 --dec -5.4 --roll 30 --fov 12 --out orion.png --truth orion.json
  helmstar render --ra 10 --dec 41 --camera cam.toml --bits 16 --format fits --time 2024-03-01T20:00:00
  helmstar render --ra 10 --dec 41 --fov 10 --rate-deg-s 0,0.05,0 --count 30 --step 1 --out night
  helmstar attitude night --fov 10""",
        formatter_class=raw,
    )
    c.add_argument("--ra", type=float, required=True, metavar="DEG", help="right ascension of the image's centre")
    c.add_argument("--dec", type=float, required=True, metavar="DEG", help="its declination")
    c.add_argument("--roll", type=float, default=0.0, metavar="DEG", help="north from image up, counter-clockwise")
    c.add_argument("--camera", metavar="TOML", help="camera (docs/imaging.md)")
    c.add_argument("--fov", type=float, metavar="DEG", help="horizontal full field of a camera without distortion")
    c.add_argument("--size", metavar="WxH", help="its pixels (default: 1024x768)")
    c.add_argument("--time", metavar="UTC", help="of the (first) frame: moves the stars, adds aberration and parallax")
    c.add_argument("--exposure", type=float, default=0.2, metavar="S", help="exposure time (default: 0.2 s)")
    c.add_argument("--psf", type=float, default=0.8, metavar="PX", help="sigma of the point spread (default: 0.8)")
    c.add_argument(
        "--sky", type=float, default=20.0, metavar="E", help="sky, electrons a pixel and second (default: 20)"
    )
    c.add_argument(
        "--glow", action="append", default=[], metavar="X,Y,PEAK,SIGMA", help="stray light; px and electrons"
    )
    c.add_argument("--rate-deg-s", default="0,0,0", metavar="X,Y,Z", help="rate of the camera, in its axes")
    c.add_argument("--hot-pixels", type=int, default=0, metavar="N", help="pixels with much dark current")
    c.add_argument("--limit-magnitude", type=float, metavar="V", help="faintest star (default: the catalogue's)")
    c.add_argument("--catalog", choices=("hipparcos", "gaia"), default="hipparcos", help="V to 9, or G to 10")
    c.add_argument("--seed", type=int, default=0, metavar="S", help="of the noise; frame k of a sequence has S + k")
    c.add_argument("--bits", type=int, choices=(8, 16), default=8, help="of a pixel (default: 8)")
    c.add_argument("--format", choices=("png", "fits", "tiff"), help="default: what --out ends in, or png")
    c.add_argument("--count", type=int, metavar="N", help="a sequence of N frames in the folder --out, with frames.csv")
    c.add_argument("--step", type=float, default=1.0, metavar="S", help="time between its frames (default: 1 s)")
    c.add_argument("--truth", metavar="JSON", help="file for the truth (of a sequence: truth.json in its folder)")
    c.add_argument("--out", metavar="PATH", help="file, or folder of a sequence (default: frame.png)")
    c.add_argument("--json", action="store_true", help="one JSON object on stdout, progress on stderr")

    c = sub.add_parser(
        "calibrate",
        help="camera from many images of stars: focal length, centre, distortion, noise of the centroids",
        description="""Fit one camera to all images of stars, solved without a prior, and write cam.toml for solve --camera.
Images that are not solved or have another size are named and left out.
Exit code: 0 all images were used, 2 some were not, 1 misuse or too few stars.""",
        epilog="""examples:
  helmstar calibrate night/*.png --fov 11.4
  helmstar calibrate *.fits --fov 5..25 --pixel-aspect 1.9 --dark --out cam.toml --plot drawn""",
        formatter_class=raw,
    )
    c.misuse = 1
    c.add_argument("files", nargs="+", metavar="IMAGE", help="images of stars by one camera")
    c.add_argument("--fov", metavar="DEG", help="horizontal full field, 11.4, or a range, 5..25 (default: 4..30)")
    c.add_argument("--camera", metavar="TOML", help="camera to start from")
    c.add_argument("--pixel-aspect", type=float, metavar="R", help="fit pixel height over width too, from this value")
    c.add_argument("--time", metavar="UTC", help="time of the images: moves the stars and adds aberration")
    c.add_argument("--dark", action="store_true", help="estimate the pixels that always shine, beside cam.toml")
    c.add_argument("--out", metavar="TOML", default="cam.toml", help="file to write (default: cam.toml)")
    c.add_argument("--plot", metavar="DIR", help="folder for a drawing of the residuals before and after")
    c.add_argument("--json", action="store_true", help="one JSON object on stdout, progress on stderr")

    c = sub.add_parser(
        "opnav",
        help="centres of a target body in frames, and the probe's trajectory relative to it",
        description="""Find the centre of figure of a body in frames (FITS or images) with its covariance, and the probe's
trajectory relative to the body. Times are those of FITS headers, or of a table with the columns file and time_utc or time_s
among the frames. The attitude is a table as `helmstar attitude` writes it.
Exit code: 0 all centres found, 2 some not, 1 misuse.""",
        epilog="""examples:
  helmstar opnav frames/*.fits --camera cam.toml --attitude attitude.parquet --body body.toml
  helmstar opnav frames.csv --camera cam.toml --attitude attitude.parquet --body body.toml --json --out nav""",
        formatter_class=raw,
    )
    c.misuse = 1
    c.add_argument("files", nargs="+", metavar="FRAME", help="frames of the body, and tables of their times")
    c.add_argument("--camera", required=True, metavar="TOML", help="camera, its mounting and detector (docs/opnav.md)")
    c.add_argument("--attitude", required=True, metavar="TABLE", help="attitude.parquet or .csv of the probe")
    c.add_argument("--body", required=True, metavar="TOML", help="the body, the Sun, where the probe is expected")
    c.add_argument(
        "--method", default="auto", metavar="M", help="moment, fit, limb, or auto by apparent size (default)"
    )
    c.add_argument("--no-plots", action="store_true", help="write no drawing of each frame")
    _common(c, "helmstar-out/opnav-BODY")

    c = sub.add_parser(
        "allan",
        help="Allan deviation of gyro data: angle random walk, rate random walk, bias instability",
        description="Allan deviation of gyro data with fitted noise parameters, printed as a [gyro] table for sensors.toml.",
        epilog="""examples:
  helmstar allan gyro.csv
  helmstar allan gyro.csv --config columns.toml --json""",
        formatter_class=raw,
    )
    c.add_argument("files", nargs="+", metavar="FILE", help="CSV or Parquet tables with gyro columns")
    c.add_argument("--config", metavar="TOML", help="sensors.toml with [columns] and [gyro] reading")
    c.add_argument("--strict", action="store_true", help="a bad row is an error instead of being dropped and reported")
    _common(c, "helmstar-out/allan-FILE")
    return p


def _common(c: argparse.ArgumentParser, default: str) -> None:
    c.add_argument("--out", metavar="DIR", help=f"folder for results, created or reused (default: {default})")
    c.add_argument("--json", action="store_true", help="one JSON object on stdout, progress on stderr")


__all__ = ["parser"]
