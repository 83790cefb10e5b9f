"""The command line: call what `parser` understood, print. Everything heavy is imported by the command that needs it.

With `--json` stdout is one object of finite numbers and nulls; progress and messages go to stderr, and the last line of
stderr states an error. Exit codes: 0 done, 1 an error that the message explains, 2 wrong usage (of `solve`, `calibrate`
and `opnav`: 1, where 2 says that some image was of no use), 130 interrupted.
"""

from __future__ import annotations

import argparse
import io
import json
import os
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from .errors import HelmstarError
from .parser import parser


def _print_json(value: Any) -> None:
    print(json.dumps(value, allow_nan=False))


def _say(text: str) -> None:
    print(text, file=sys.stderr)


def _command(args: argparse.Namespace) -> str:
    """The command as typed, for the report and for tables, whose texts are UTF-8; without --resume, which reproduces nothing."""
    from .files import readable

    resumes = {"--resume"[:n] for n in range(len("--re"), len("--resume") + 1)}  # argparse takes a beginning too
    words = args.argv if args.command != "run" else [word for word in args.argv if word not in resumes]
    return readable("helmstar " + shlex.join(words))


def _run(args: argparse.Namespace) -> int:
    from .errors import ConfigurationError
    from .scenarios.specification import build, load, parse_set

    overrides = parse_set(args.set)
    for key in ("runs", "seed"):
        value = getattr(args, key)
        if value is not None and key in overrides:
            raise ConfigurationError(f"--{key} {value} and --set {key}: both set the same thing; give one of them")
        if value is not None:
            overrides[key] = value
    name, spec = load(args.scenario, overrides)
    if args.workers is not None and args.workers < 1:
        raise ConfigurationError(f"--workers {args.workers}: must be at least 1")
    if args.batch is not None and args.batch < 1:
        raise ConfigurationError(f"--batch {args.batch}: must be at least 1")
    _say(f"{name}: {spec.runs} runs, seed {spec.seed}")
    if spec.note:
        _say(spec.note)
    from .campaign import run_campaign
    from .campaign.runner import default_workers

    experiment = build(name, spec, args.workers or default_workers())
    folder = Path(args.out or Path("helmstar-out") / f"{name}-{spec.seed}")
    outcome = run_campaign(
        experiment,
        runs=spec.runs,
        seed=spec.seed,
        folder=folder,
        specification=spec.model_dump(mode="json"),
        configuration=_as_toml(spec.model_dump(mode="json", exclude_none=True)),
        command=_command(args),
        estimators=None if args.estimators is None else args.estimators.split(","),
        resume=args.resume,
        workers=args.workers,
        processes=True,
        batch=args.batch,
        dask=args.dask,
    )
    from .files import write_atomically
    from .report.monte_carlo import write_monte_carlo_report

    claims = experiment.claims(outcome.dataset, outcome.summary)
    report = write_monte_carlo_report(outcome.dataset, outcome.summary, claims, folder / "report.html")
    write_atomically(folder / "summary.json", json.dumps(outcome.summary, allow_nan=False, indent=2))
    if args.json:
        _print_json(outcome.summary)
    else:
        from .report.terminal import print_campaign

        print_campaign(outcome.summary)
        print(f"report: {report.resolve()}")
    if outcome.interrupted:
        again = _command(args) + " --resume"
        _say(f"interrupted: {outcome.summary['runs']} of {spec.runs} runs are kept in {folder}; go on with: {again}")
        return 130
    return 0


def _as_toml(value: dict[str, Any], prefix: str = "") -> str:
    """A validated specification as TOML, for the report (values are numbers, strings and lists)."""
    plain = [f"{k} = {json.dumps(v)}" for k, v in value.items() if not isinstance(v, dict)]
    out = "\n".join(plain)
    for k, v in value.items():
        if isinstance(v, dict):
            out += f"\n\n[{prefix}{k}]\n{_as_toml(v, f'{prefix}{k}.')}"
    return out


def _scenarios(args: argparse.Namespace) -> int:
    import tomllib

    from .errors import ConfigurationError
    from .scenarios.specification import library

    built_in = library()
    if args.scenario is not None and args.scenario not in built_in:
        raise ConfigurationError(f"scenario {args.scenario!r}: no such scenario; there are {', '.join(built_in)}")
    if args.scenario is not None:
        content = built_in[args.scenario]
        if args.json:
            _print_json(tomllib.loads(content))
        else:
            print(content, end="")
        return 0
    content = {name: tomllib.loads(text) for name, text in built_in.items()}
    if args.json:
        _print_json({"scenarios": [{"name": n, "title": c["title"], "runs": c["runs"]} for n, c in content.items()]})
        return 0
    for name, c in content.items():
        print(f"{name:<12} {c['title']}")
        print(f"{'':<12} {c['runs']} runs; print its keys: helmstar scenarios {name}; run it: helmstar run {name}")
    return 0


def _telemetry(args: argparse.Namespace, unnamed: str) -> dict[str, Any]:
    """What the commands on telemetry share; `unnamed`: what the default folder is named after where the file has no name."""
    stem = Path(args.files[0]).stem or unnamed
    return {
        "config": None if args.config is None else Path(args.config),
        "folder": Path(args.out or Path("helmstar-out") / f"{args.command}-{stem}"),
        "strict": args.strict,
        "command": _command(args),
    }


def _attitude(args: argparse.Namespace) -> int:
    from .startracker.command import SolveOptions
    from .telemetry.command import run_attitude

    files = [Path(f) for f in args.files]
    optics = SolveOptions(args.fov, None if args.camera is None else Path(args.camera), args.pixel_aspect)
    result, report = run_attitude(
        files, **_telemetry(args, "telemetry"), as_csv=args.csv, aem=args.aem, ck=args.ck, optics=optics
    )
    if args.json:
        _print_json(result)
    else:
        from .report.terminal import print_attitude

        print_attitude(result)
        for name, file in result.get("exports", {}).items():
            print(f"{name}: {Path(file).resolve()}")
        print(f"report: {report.resolve()}")
    return 0


def _allan(args: argparse.Namespace) -> int:
    from .telemetry.allan import run_allan

    result, report = run_allan([Path(f) for f in args.files], **_telemetry(args, "gyro"))
    if args.json:
        _print_json(result)
    else:
        print(result["sensors_toml"], end="")
        print(f"report: {report.resolve()}")
    return 0


def _solve(args: argparse.Namespace) -> int:
    from .startracker.command import SolveOptions, print_solved, run_solve

    result = run_solve(
        [Path(f) for f in args.files],
        SolveOptions(
            fov=args.fov,
            camera=None if args.camera is None else Path(args.camera),
            aspect=args.pixel_aspect,
            time=args.time,
            plot=None if args.plot is None else Path(args.plot),
            limit=args.max_false,
            catalog=args.catalog,
        ),
    )
    if args.json:
        _print_json(result)
    else:
        print_solved(result)
    return 0 if all(e["status"] == "solved" for e in result["images"]) else 2


def _render(args: argparse.Namespace) -> int:
    from .startracker.render_command import RenderOptions, print_rendered, run_render

    path = lambda text: None if text is None else Path(text)
    result = run_render(
        RenderOptions(
            args.ra, args.dec, args.roll, fov_deg=args.fov, size=args.size, camera=path(args.camera), time=args.time,
            exposure_s=args.exposure, psf_sigma_px=args.psf, sky_e_s=args.sky, glow=tuple(args.glow),
            rate_deg_s=args.rate_deg_s, hot_pixels=args.hot_pixels, limit_magnitude=args.limit_magnitude,
            catalog=args.catalog, seed=args.seed, bits=args.bits, format=args.format, count=args.count,
            step_s=args.step, out=path(args.out), truth=path(args.truth),
        )
    )  # fmt: skip
    if args.json:
        _print_json(result)
    else:
        print_rendered(result)
    return 0


def _calibrate(args: argparse.Namespace) -> int:
    from .startracker.calibrate_command import CalibrateOptions, print_calibrated, run_calibrate
    from .startracker.command import SolveOptions

    solve = SolveOptions(fov=args.fov, camera=None if args.camera is None else Path(args.camera), time=args.time)
    plot = None if args.plot is None else Path(args.plot)
    options = CalibrateOptions(solve, args.pixel_aspect, Path(args.out), args.dark, plot)
    result = run_calibrate([Path(f) for f in args.files], options)
    if args.json:
        _print_json(result)
    else:
        print_calibrated(result)
    return 0 if all(e["status"] == "used" for e in result["images"]) else 2


def _opnav(args: argparse.Namespace) -> int:
    from .opnav.command import OpnavOptions, print_opnav, run_opnav

    folder = Path(args.out or Path("helmstar-out") / f"opnav-{Path(args.body).stem or 'body'}")
    options = OpnavOptions(
        camera=Path(args.camera),
        attitude=Path(args.attitude),
        body=Path(args.body),
        folder=folder,
        method=args.method,
        plots=not args.no_plots,
        command=_command(args),
    )
    result = run_opnav([Path(f) for f in args.files], options)
    if args.json:
        _print_json(result)
    else:
        print_opnav(result)
    return 0 if all(e["status"] == "found" for e in result["frames"]) else 2


COMMANDS = {
    "run": _run,
    "scenarios": _scenarios,
    "attitude": _attitude,
    "solve": _solve,
    "render": _render,
    "calibrate": _calibrate,
    "opnav": _opnav,
    "allan": _allan,
}


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point of the console command; returns the exit code."""
    argv = list(sys.argv[1:] if argv is None else argv)
    args = parser().parse_args(argv)
    args.argv = argv
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # a file's name may hold bytes that are no text
    try:
        return COMMANDS[args.command](args)
    except HelmstarError as error:
        # Several errors are several lines; indented ones are details of what the last line states.
        _say("\n".join(s if s.startswith(" ") else f"error: {s}" for s in str(error).splitlines() or [""]))
        return 1
    except KeyboardInterrupt:
        _say("interrupted: nothing was finished")
        return 130
    except BrokenPipeError:  # `helmstar ... | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OSError as error:
        _say(f"error: {error.filename or ''}: {error.strerror or error}".replace(": :", ":"))
        return 1


def entry() -> None:
    """The installed command: as `main`, without the interpreter's tear-down, which frees JAX's caches for most of a second."""
    code = main()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


if __name__ == "__main__":
    entry()
