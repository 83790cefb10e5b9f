"""The command line: one JSON object on stdout, messages on stderr, exit codes, help that teaches."""

from __future__ import annotations

import json
import math
import os
import signal
import subprocess
import sys
import time

import pytest

from helmstar.cli import COMMANDS, main
from helmstar.parser import parser

SMALL = ["--runs", "3", "--set", "updates=20", "--set", "width=4", "--estimators", "lie,mekf_tuned"]


def call(capsys, *argv: str) -> tuple[int, str, str]:
    code = main(list(argv))
    out = capsys.readouterr()
    return code, out.out, out.err


def numbers(value):
    if isinstance(value, dict):
        for v in value.values():
            yield from numbers(v)
    elif isinstance(value, list):
        for v in value:
            yield from numbers(v)
    elif isinstance(value, float | int):
        yield value


def test_run_prints_one_json_object_of_the_stated_shape(capsys, tmp_path):
    code, out, err = call(capsys, "run", "xu2020", *SMALL, "--out", str(tmp_path), "--json")
    assert code == 0
    assert out.count("\n") == 1
    result = json.loads(out)
    assert result.keys() == {"scenario", "seed", "runs", "wall_s", "estimators"}
    assert (result["scenario"], result["seed"], result["runs"]) == ("xu2020", 0, 3)
    assert list(result["estimators"]) == ["lie", "mekf_tuned"]
    for m in result["estimators"].values():
        assert m.keys() == {
            "rms_deg", "median_error_deg", "converged", "diverged", "nees_mean", "rms_over_bound", "us_per_step",
        }  # fmt: skip
        assert m["converged"].keys() == {"1deg", "0.1deg"}
        assert m["us_per_step"] > 0
    assert all(math.isfinite(x) for x in numbers(result))
    assert {f.name for f in tmp_path.iterdir()} >= {"results.nc", "report.html", "summary.json", "campaign.json"}
    assert json.loads((tmp_path / "summary.json").read_text()) == result
    assert "xu2020: 3 runs" in err


def test_run_for_people_ends_with_the_report(capsys, tmp_path):
    code, out, _ = call(capsys, "run", "xu2020", *SMALL, "--out", str(tmp_path))
    assert code == 0
    last = out.strip().splitlines()[-1]
    assert last == f"report: {(tmp_path / 'report.html').resolve()}"
    assert max(map(len, out.splitlines()[:-1])) <= 88


def test_the_default_folder_is_named_after_scenario_and_seed(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert call(capsys, "run", "xu2020", *SMALL, "--seed", "4", "--json")[0] == 0
    assert (tmp_path / "helmstar-out" / "xu2020-4" / "results.nc").exists()


def test_a_reused_folder_holds_the_new_campaign(capsys, tmp_path):
    call(capsys, "run", "xu2020", *SMALL, "--out", str(tmp_path), "--json")
    code, out, err = call(capsys, "run", "xu2020", *SMALL, "--seed", "2", "--out", str(tmp_path), "--json")
    assert code == 0
    assert "discarded 3 finished runs of an earlier campaign" in err
    assert json.loads(out)["seed"] == 2


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (["run", "nothing"], ["nothing", "xu2020"]),
        (["run", "xu2020", "--set", "star.sigma_arcsec=-3"], ["star.sigma_arcsec", "-3", ">= 0"]),
        (["run", "xu2020", "--set", "star.sigma"], ["KEY=VALUE"]),
        (["run", "xu2020", "--runs", "0"], ["runs", "0"]),
        (["run", "xu2020", "--runs", "3", "--set", "runs=4"], ["--runs 3", "--set runs", "give one of them"]),
        (["run", "xu2020", "--seed", "3", "--set", "seed=4"], ["--seed 3", "--set seed", "give one of them"]),
        (["run", "xu2020", "--estimators", "magic"], ["magic", "lie_printed"]),
        (["run", "xu2020", "--workers", "0"], ["--workers"]),
        (["run", "missing.toml"], ["missing.toml"]),
        (["scenarios", "nothing"], ["nothing", "xu2020"]),
        (["attitude", "missing.csv"], ["missing.csv"]),
        (["allan", "missing.csv"], ["missing.csv"]),
        (["attitude", "missing.csv", "--config", "missing.toml"], ["missing.toml"]),
    ],
)
@pytest.mark.parametrize("json_too", [False, True])
def test_an_error_is_one_message_on_stderr_without_a_traceback(capsys, tmp_path, monkeypatch, argv, words, json_too):
    monkeypatch.chdir(tmp_path)
    code, out, err = call(capsys, *argv, *(["--json"] if json_too else []))
    assert code == 1
    assert out == ""
    last = err.strip().splitlines()[-1]
    assert last.startswith("error: ")
    for word in words:
        assert word in last
    assert "Traceback" not in err


def test_wrong_usage_exits_with_2(capsys):
    usages = (
        [],
        ["run"],
        ["fly"],
        ["run", "xu2020", "--runs", "many"],
        ["run", "xu2020", "a\nb"],
        ["attitude", "--fast"],
    )
    for argv in usages:
        with pytest.raises(SystemExit) as e:
            main(argv)
        assert e.value.code == 2
        first, *_, last = capsys.readouterr().err.splitlines()
        assert first.startswith("usage: helmstar")
        assert last.startswith("error: ")


def test_the_recorded_command_reproduces_from_nothing(capsys, tmp_path):
    command = ["run", "xu2020", *SMALL, "--out", str(tmp_path), "--json"]
    assert call(capsys, *command)[0] == 0
    for word in ("--resume", "--re"):
        assert call(capsys, *command, word)[0] == 0
        assert "--re" not in json.loads((tmp_path / "campaign.json").read_text())["command"]


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help_with_an_example(capsys, command):
    with pytest.raises(SystemExit) as e:
        main([command, "--help"])
    assert e.value.code == 0
    out = capsys.readouterr().out
    assert "examples:" in out
    assert f"helmstar {command}" in out


def test_every_example_of_the_help_parses():
    p = parser()
    texts = [p.epilog or ""]
    for action in p._subparsers._group_actions:  # type: ignore[union-attr]
        texts += [c.epilog or "" for c in action.choices.values()]
    examples = [line.strip() for t in texts for line in t.splitlines() if line.strip().startswith("helmstar ")]
    assert len(examples) >= 10
    for line in examples:
        words = line.split("   ")[0].split(">")[0].split()[1:]
        p.parse_args(words)


def test_scenarios_for_people_and_programs(capsys):
    code, out, _ = call(capsys, "scenarios")
    assert code == 0
    assert "xu2020" in out
    listed = json.loads(call(capsys, "scenarios", "--json")[1])
    assert "xu2020" in [s["name"] for s in listed["scenarios"]]
    text = call(capsys, "scenarios", "xu2020")[1]
    assert 'experiment = "xu2020"' in text
    assert json.loads(call(capsys, "scenarios", "xu2020", "--json")[1])["star"]["sigma_arcsec"] == 20.0


def test_a_printed_scenario_runs_as_a_users_own(capsys, tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(call(capsys, "scenarios", "xu2020")[1])
    code, out, _ = call(capsys, "run", str(path), *SMALL, "--out", str(tmp_path / "out"), "--json")
    assert code == 0
    assert json.loads(out)["scenario"] == "mine"


def test_ctrl_c_in_a_real_process_keeps_what_is_finished(tmp_path):
    argv = [
        sys.executable,
        "-m",
        "helmstar",
        "run",
        "xu2020",
        "--runs",
        "4000",
        "--set",
        "updates=20",
        "--set",
        "width=4",
    ]
    argv += ["--estimators", "lie,mekf_tuned", "--out", str(tmp_path), "--json"]
    # Whoever runs the tests in a shell's background has handed down that Ctrl-C is ignored.
    process = subprocess.Popen(
        argv, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )  # fmt: skip
    blocks = tmp_path / "blocks"
    for _ in range(1200):  # until blocks appear; a minute and more on a busy machine
        if blocks.exists() and len(list(blocks.glob("*.nc"))) >= 3:
            break
        time.sleep(0.1)
    os.kill(process.pid, signal.SIGINT)
    out, err = process.communicate(timeout=120)
    assert process.returncode == 130, err
    assert 0 < json.loads(out)["runs"] < 4000
    assert "--resume" in err.strip().splitlines()[-1]
    assert "Traceback" not in err
