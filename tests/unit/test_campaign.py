"""Campaigns: the same bits however the work is split, resumed or cut short; nothing finished is lost."""

from __future__ import annotations

import dataclasses
import importlib
import json
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from helmstar.backend import jax
from helmstar.campaign import engine as engine_module
from helmstar.campaign import run_campaign
from helmstar.campaign import runner as runner_module
from helmstar.campaign import store as store_module
from helmstar.campaign.engine import Engine
from helmstar.campaign.programs import _stored, compiled, exported
from helmstar.campaign.runner import choose
from helmstar.campaign.store import Store
from helmstar.errors import CampaignError, ConfigurationError
from helmstar.filters import ErrorStateKalmanFilter
from helmstar.geometry.retraction import euclidean, product, so3_left, so3_right
from helmstar.models.attitude import AttitudeDrift
from helmstar.scenarios import build, load
from helmstar.scenarios.experiment import Call

SMALL = {"updates": 20, "width": 4}
MANIFEST = {"specification": {"width": 4}, "runs": 7, "estimators": ["lie"], "helmstar_version": "0"}


def prepared(**overrides):
    name, spec = load("xu2020", SMALL | {k.replace("__", "."): v for k, v in overrides.items()})
    return build(name, spec), spec


def run(
    folder: Path,
    runs: int,
    names=("lie", "mekf_tuned"),
    resume=False,
    workers=1,
    batch=None,
    dask=None,
    processes=False,
    **overrides,
):
    experiment, spec = prepared(**overrides)
    return run_campaign(
        experiment,
        runs=runs,
        seed=spec.seed,
        folder=folder,
        specification=spec.model_dump(mode="json"),
        configuration="",
        command="helmstar run xu2020",
        estimators=names,
        resume=resume,
        workers=workers,
        batch=batch,
        dask=dask,
        processes=processes,
        progress=False,
    )


def same_bits(a: xr.Dataset, b: xr.Dataset) -> bool:
    return all(
        np.array_equal(a[v].values, b[v].values, equal_nan=True)
        for v in ("error_rad", "sigma_rad", "nees", "nis", "nis_dof", "truth_q_bn", "bound_rad")
    )


@pytest.fixture(scope="module")
def eleven(tmp_path_factory):
    return run(tmp_path_factory.mktemp("eleven"), 11)


def test_a_dataset_with_dims_units_and_frames(eleven):
    d = eleven.dataset
    assert dict(d.sizes) == {"estimator": 2, "run": 11, "time": 20, "axis": 3, "quaternion": 4}
    assert d["error_rad"].attrs["units"] == "rad"
    assert d["error_rad"].attrs["frame"] == "N"
    assert d["update"].values.tolist() == list(range(1, 21))
    assert np.isfinite(d["error_rad"].values).all()


def test_results_on_disk_are_the_results(eleven, tmp_path):
    outcome = run(tmp_path, 11)
    with xr.open_dataset(tmp_path / "results.nc", engine="h5netcdf") as d:
        assert same_bits(d.load(), eleven.dataset)
        assert d.attrs["runs"] == 11
    assert not [f for f in tmp_path.rglob("*") if f.suffix in (".pkl", ".pickle", ".part")]
    assert outcome.summary["estimators"].keys() == {"lie", "mekf_tuned"}


def test_the_bits_do_not_depend_on_runs_workers_or_resume(eleven, tmp_path):
    few = run(tmp_path / "a", 3)
    assert same_bits(few.dataset, eleven.dataset.isel(run=slice(0, 3)))
    assert same_bits(run(tmp_path / "b", 11, workers=2).dataset, eleven.dataset)
    assert same_bits(run(tmp_path / "c", 11, workers=2, batch=7).dataset, eleven.dataset)
    again = run(tmp_path / "a", 11, resume=True)
    assert same_bits(again.dataset, eleven.dataset)


def test_other_processes_give_the_same_bits(eleven, tmp_path, monkeypatch):
    from helmstar.campaign import runner

    monkeypatch.setattr(runner, "HELP_PAYS_S", -1.0)
    asked = []
    original = runner.ProcessPoolExecutor.submit
    monkeypatch.setattr(runner.ProcessPoolExecutor, "submit", lambda pool, *a: asked.append(a) or original(pool, *a))
    outcome = run(tmp_path, 11, workers=2, processes=True)
    assert asked  # else nobody helped
    assert same_bits(outcome.dataset, eleven.dataset)


def test_a_dask_cluster_gives_the_same_bits(eleven, tmp_path, monkeypatch):
    distributed = pytest.importorskip("distributed", reason="the dask extra is not installed: this test did not run")
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None
    ) as cluster:
        config, schedulers, save = importlib.import_module("dask.config"), [], Store.save

        def kept(store, *args):
            schedulers.append(config.get("scheduler", None))
            save(store, *args)

        monkeypatch.setattr(Store, "save", kept)
        outcome = run(tmp_path, 11, dask=cluster.scheduler_address)
    assert same_bits(outcome.dataset, eleven.dataset)
    # A default client would be asked for a lock of every file that is written, by this campaign and by all later ones.
    assert set(schedulers) == {None}
    assert config.get("scheduler", None) is None


def test_a_dask_address_without_a_scheduler(tmp_path, monkeypatch):
    pytest.importorskip("distributed", reason="the dask extra is not installed: this test did not run")
    with pytest.raises(CampaignError, match="no scheduler answers"):
        run(tmp_path, 4, dask="not-an-address://x")


def test_another_estimator_leaves_the_others_as_they_are(eleven, tmp_path):
    more = run(tmp_path, 11, names=("lie", "static_svd", "mekf_tuned")).dataset.sel(estimator=["lie", "mekf_tuned"])
    assert same_bits(more, eleven.dataset)


def test_another_width_draws_the_same_noise(eleven, tmp_path):
    """Other programs may round differently: the attitudes agree within 1e-11 rad."""
    other = run(tmp_path, 11, width=5)
    assert np.abs(other.dataset["error_rad"].values - eleven.dataset["error_rad"].values).max() < 1e-11


def test_another_seed_is_another_draw(eleven, tmp_path):
    assert not same_bits(run(tmp_path, 11, seed=1).dataset, eleven.dataset)


def test_runs_are_different_from_each_other(eleven):
    e = eleven.dataset["error_rad"].values[0]
    assert len(np.unique(e[:, -1, 0])) == 11


def test_a_longer_campaign_begins_with_the_same_draws(eleven, tmp_path):
    longer = run(tmp_path, 4, updates=30).dataset
    difference = longer["error_rad"].values[:, :, :20] - eleven.dataset["error_rad"].values[:, :4]
    assert np.abs(difference).max() < 1e-11


def test_resume_computes_only_what_is_missing(tmp_path, monkeypatch):
    run(tmp_path, 8)
    computed = []
    compute = Engine.compute
    monkeypatch.setattr(Engine, "compute", lambda self, i, *a: (computed.append(i), compute(self, i, *a))[1])
    run(tmp_path, 12, resume=True)
    assert computed == [2]


def test_ctrl_c_keeps_what_is_finished_and_resume_goes_on(tmp_path, monkeypatch, eleven):
    compute = Engine.compute
    calls = []

    def interrupted(self, index, *args):
        if index == 2:
            raise KeyboardInterrupt
        calls.append(index)
        return compute(self, index, *args)

    # A KeyboardInterrupt in the waiting main thread is what Ctrl-C gives; here it comes out of wait().
    import helmstar.campaign.runner as runner

    wait = runner.wait

    def waiting(pending, **kwargs):
        done = wait(pending, **kwargs)
        if len(calls) == 2:
            calls.append(None)
            raise KeyboardInterrupt
        return done

    monkeypatch.setattr(Engine, "compute", interrupted)
    monkeypatch.setattr(runner, "wait", waiting)
    outcome = run(tmp_path, 11)
    assert outcome.interrupted
    assert outcome.summary["runs"] == 8
    assert outcome.dataset.attrs["requested_runs"] == 11
    monkeypatch.undo()
    whole = run(tmp_path, 11, resume=True)
    assert not whole.interrupted
    assert same_bits(whole.dataset, eleven.dataset)


def test_ctrl_c_before_anything_is_finished(tmp_path, monkeypatch):
    def interrupt(*_):
        raise KeyboardInterrupt

    import helmstar.campaign.runner as runner

    monkeypatch.setattr(runner, "_compute", interrupt)
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, 4)


def test_a_crash_keeps_finished_blocks(tmp_path, monkeypatch):
    compute = Engine.compute

    def crash(self, index, *args):
        if index == 1:
            raise RuntimeError("out of memory")
        return compute(self, index, *args)

    monkeypatch.setattr(Engine, "compute", crash)
    with pytest.raises(CampaignError, match=r"out of memory.*4 runs are kept"):
        run(tmp_path, 8)
    monkeypatch.undo()
    assert run(tmp_path, 8, resume=True).summary["runs"] == 8


def test_a_damaged_block_is_computed_again(tmp_path, eleven):
    run(tmp_path, 11)
    (tmp_path / "blocks" / "000001.nc").write_bytes(b"rubbish")
    with pytest.raises(CampaignError, match="--resume computes it again"):
        run(tmp_path, 11, resume=True)
    assert same_bits(run(tmp_path, 11, resume=True).dataset, eleven.dataset)


def test_resume_refuses_another_campaign_and_names_what_differs(tmp_path):
    run(tmp_path, 4)
    with pytest.raises(CampaignError, match=r"star\.sigma_arcsec"):
        run(tmp_path, 4, resume=True, star__sigma_arcsec=5)
    with pytest.raises(CampaignError, match="seed"):
        run(tmp_path, 4, resume=True, seed=9)


def test_resume_without_a_campaign_or_with_a_damaged_manifest(tmp_path):
    with pytest.raises(CampaignError, match="holds no campaign"):
        run(tmp_path, 4, resume=True)
    (tmp_path / "campaign.json").write_text("{")
    with pytest.raises(CampaignError, match="damaged"):
        run(tmp_path, 4, resume=True)


def test_only_a_campaigns_own_blocks_are_deleted(tmp_path):
    foreign = tmp_path / "blocks" / "house.nc"
    foreign.parent.mkdir()
    foreign.write_text("mine")
    with pytest.raises(CampaignError, match=r"blocks holds \.nc files"):
        Store(tmp_path, MANIFEST, resume=False)
    assert foreign.read_text() == "mine"
    (tmp_path / "campaign.json").write_text(json.dumps(MANIFEST))
    for name in ("000000.nc", "000001.nc", "12.nc", "²²²²²².nc"):
        (tmp_path / "blocks" / name).write_text("x")
    store = Store(tmp_path, MANIFEST, resume=False)
    assert store.discarded == "7 finished runs"
    assert {f.name for f in foreign.parent.iterdir()} == {"house.nc", "12.nc", "²²²²²².nc"}
    assert Store(tmp_path, MANIFEST, resume=False).discarded == ""
    (tmp_path / "blocks" / "000000.nc").write_text("x")
    (tmp_path / "campaign.json").write_text("{")
    assert Store(tmp_path, MANIFEST, resume=False).discarded == "1 finished block"


def test_the_blocks_kept_in_memory_are_bounded(tmp_path, monkeypatch, eleven):
    monkeypatch.setattr(store_module, "KEPT_BYTES", 0)
    opened = []
    read = xr.open_dataset
    monkeypatch.setattr(xr, "open_dataset", lambda path, **k: (opened.append(path), read(path, **k))[1])
    assert same_bits(run(tmp_path, 11).dataset, eleven.dataset)
    assert len(opened) == 3


def test_the_finished_blocks_are_listed_a_fixed_number_of_times(tmp_path, monkeypatch):
    listed = []
    finished = Store.finished
    monkeypatch.setattr(Store, "finished", lambda self: (listed.append(1), finished(self))[1])
    monkeypatch.setattr(runner_module, "_compute", lambda *_: True)
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, 400)
    assert len(listed) <= 3


def test_an_output_folder_that_cannot_be_written(tmp_path):
    (tmp_path / "file").write_text("x")
    with pytest.raises(CampaignError, match="cannot write"):
        run(tmp_path / "file" / "below", 4)


def test_tunings_and_twins_share_programs():
    experiment, _ = prepared()
    engine = Engine(experiment, experiment.estimators)
    # simulate; right EKF printed and consistent; left; gibbs; additive (one and two stars); UKF; static
    assert len(engine._jobs) == 8
    other, _ = prepared(tuning__q_w=1e-4, star__sigma_arcsec=3)
    assert set(Engine(other, other.estimators)._jobs) == set(engine._jobs)


def _a_users(factor):
    def add(a, data):
        return {"x": factor * a.sum() + data.sum()}

    return add


def test_a_users_function_that_changed_is_traced_again():
    """Nothing but its meaning differs: same module, same name. A kept program would give the first result again."""
    results = [compiled(exported(Call(_a_users(f), (np.ones(3),)), np.ones(2)))(np.ones(3), np.ones(2)) for f in (1, 7)]
    assert [float(r[0]) for r in results] == [5.0, 23.0]


def test_programs_are_kept_only_for_what_is_helmstars_alone(monkeypatch, tmp_path):
    monkeypatch.setitem(jax.config.values, "jax_compilation_cache_dir", str(tmp_path))
    experiment, _ = prepared()
    paths = {n: _stored(call, None) for n, call in experiment.estimators.items()}
    assert None not in paths.values()
    assert len(set(paths.values())) == 7  # as many as there are programs
    call = experiment.estimators["lie"]
    assert _stored(call, None) == _stored(prepared()[0].estimators["lie"], None)
    model, *rest = call.arguments
    (sensor,) = model.sensors
    mine = dataclasses.replace(sensor, minus=lambda z, z_hat: (z - z_hat).reshape(-1))
    assert _stored(Call(call.function, (dataclasses.replace(model, sensors=(mine,)), *rest), call.static), None) is None
    # What a function of helmstar's closes over counts: products differ by their parts, and a part may be a user's.
    foreign = dataclasses.replace(so3_left, boxplus=_a_users(1))
    with_parts = [product(AttitudeDrift, part, euclidean(3)) for part in (so3_left, so3_right, foreign)]
    found = [_stored(Call(call.function, (), {"filter": ErrorStateKalmanFilter(p)}), None) for p in with_parts]
    assert found[0] != found[1]
    assert None not in found[:2]
    assert found[2] is None


def test_unknown_estimators_are_named():
    experiment, _ = prepared()
    with pytest.raises(ConfigurationError, match="'eskf' is not allowed: must be of lie_printed, lie"):
        choose(experiment, ["lie", "eskf"])
    with pytest.raises(ConfigurationError, match="none given"):
        choose(experiment, [""])
    assert choose(experiment, ["mekf", "lie", "lie"]) == ["lie", "mekf"]


def test_all_noise_off_gives_finite_summaries(tmp_path):
    outcome = run(tmp_path, 2, names=None, star__sigma_arcsec=0, gyro__sigma_rad_step=0)
    text = json.dumps(outcome.summary, allow_nan=False)
    assert json.loads(text)["estimators"]["lie_tuned"]["rms_over_bound"] == [None, None, None]
    assert np.isfinite(outcome.dataset["error_rad"].values).all()


def test_the_engine_pads_with_the_runs_that_come_next():
    assert "padded with the runs that would come next" in (engine_module.__doc__ or "")
    experiment, _ = prepared()
    engine = Engine(experiment, ["lie"])
    engine.compile(1)
    assert engine.compute(1).runs.tolist() == [4, 5, 6, 7]
