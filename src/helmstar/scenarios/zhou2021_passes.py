"""One estimator over all passes of zhou2021's runs: the scan over the timeline, and what is recorded of it.

Second k = 0.. of the base data leads from t = k to t = k + 1 s and ends with a star measurement; stars at t = 0 give the fix
from which every estimator starts. The passes of a run are one timeline (see zhou2021_timeline).
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from ..backend import jax, jnp
from ..core import RESET, Gate, Gaussian, Measurement, Model, pytree
from ..filters import (
    AdaptiveBelief,
    AdaptiveFilter,
    PredictiveBelief,
    PredictiveFilter,
    ResettableBelief,
    ResettingFilter,
    Spread,
    UnscentedBelief,
    UnscentedKalmanFilter,
    run,
    smooth,
    step,
)
from ..filters.static import turn_covariance
from ..geometry import mrp_left, quaternion, small, so3_left, so3_right, vector_part_left
from ..models.attitude import AttitudeDrift, GyroInput
from ..models.attitude_rate import AttitudeRateDrift
from .zhou2021_data import Data
from .zhou2021_timeline import CODES, CONTINUE, FROM_WRONG, STAR_LOSS_S

Array = jax.Array
EVERY = 10
"""Of the main pass's updates every so many-th is recorded; the metrics take all."""
WINDOW_S = 1000
"""RMS and NEES are over the last so many seconds of the main pass."""


@pytree
class Shared:
    """What all runs and estimators share: truth q (n + 1, 4), turned (n, 3), r_N (n + 1, k, 3), seen (n + 1, k), and the
    timeline's arrays (steps,)."""

    q: Array
    turned: Array
    r_N: Array
    seen: Array
    index: Array
    policy: Array
    dark: Array
    begin: Array
    turn: Array
    offset: Array
    save: Array


@pytree
class Bridging:
    """How lost gyro data are bridged: the mean of `hold` steps, sigma of a raised Q (rad/s), relative error of a command,
    first lost step."""

    hold: Array
    raised: Array
    command_error: Array
    first: Array


@pytree
class Prior:
    """Start and tuning of an estimator, all data. drift_sigma, rate_sigma, gyro_sigma: rad/s; wrong: attitude sigma (rad)
    told with a wrong start; star_sigma: rad; isotropic (R = sigma^2 I), random_sign (no continuity): what is made of QUEST's
    attitude; has_gyro: whether a gyro that is a sensor exists; the rest by filter."""

    drift_sigma: Array
    rate_sigma: Array
    gyro_sigma: Array
    star_sigma: Array
    wrong: Array
    gate: Gate
    isotropic: Array
    random_sign: Array
    has_gyro: Array
    fresh: Array
    rho: Array
    weight: Array
    spread: Spread
    recovered: Array


@pytree
class Step:
    """Inputs of every step of the timeline."""

    index: Array
    policy: Array
    dark: Array
    begin: Array
    turn: Array
    offset: Array
    save: Array
    rate: Array
    extra: Array
    drifts: Array


def bridged(data: Data, shared: Shared, b: Bridging) -> tuple[Array, Array, Array]:
    """Of every step of the timeline: rate (steps, 3) rad/s, additional attitude variance (steps,) rad^2, and whether the
    rate has the gyro's drift (steps,)."""
    n = data.rate.shape[0]
    before = jnp.clip(b.first - 1, 0, n - 1)
    age = b.first - 1 - jnp.arange(n)
    weight = jnp.where((age >= 0) & (age < b.hold), 1.0, 0.0)
    mean = weight @ data.rate / jnp.maximum(jnp.sum(weight), 1.0)
    own = data.rate[shared.index] + shared.offset[:, None] * data.axis
    command = (1.0 + b.command_error) * shared.turned[shared.index]
    is_ = {name: (shared.policy == code)[:, None] for name, code in CODES.items()}
    rate = jnp.where(is_["none"], own, mean)
    rate = jnp.where(is_["zeros"], 0.0, rate)
    rate = jnp.where(is_["hold_last"], data.rate[before], rate)
    rate = jnp.where(is_["commanded"], command, rate)
    raised = is_["hold_mean_raised"] | is_["rate_state"]
    extra = jnp.where(raised, b.raised**2, 0.0)[:, 0]
    wrong = b.command_error**2 * jnp.sum(command**2, axis=1)
    extra = jnp.where(is_["commanded"][:, 0], wrong, extra)
    return rate, extra, jnp.where(is_["commanded"][:, 0], 0.0, 1.0)


def make_belief(filter: Any, rated: bool, prior: Prior, q: Array, cov_B: Array, rate: Array) -> Any:
    """Belief of the filter's kind from an attitude with its covariance in B; drift 0 with its sigma, `rate` as it is told."""
    zero = jnp.zeros(3, cov_B.dtype)
    cov = turn_covariance(q, cov_B, attitude_part(filter))
    variances = [jnp.full(3, prior.drift_sigma**2)]
    if rated:
        variances.insert(0, jnp.full(3, prior.rate_sigma**2))
    P = jnp.diag(jnp.concatenate([zero, *variances])).at[:3, :3].set(cov)
    mean: Any = AttitudeRateDrift(q, rate, zero) if rated else AttitudeDrift(q, zero)
    if isinstance(filter, ResettingFilter):
        return ResettableBelief(mean, P, prior.fresh, jnp.zeros((), int))
    if isinstance(filter, AdaptiveFilter):
        return AdaptiveBelief(mean, P, jnp.ones(()), prior.rho)
    if isinstance(filter, PredictiveFilter):
        return PredictiveBelief(mean, P, prior.weight)
    if isinstance(filter, UnscentedKalmanFilter):
        return UnscentedBelief(mean, P, prior.spread)
    return Gaussian(mean, P)


def attitude_part(filter: Any) -> Any:
    """The attitude's retraction of a filter over a product that begins with it."""
    name = filter.retraction.name
    named = {r.name: r for r in (so3_left, so3_right, mrp_left, vector_part_left)}
    return named[name[name.index("(") + 1 :].split(", ")[0]]


def score(filter: Any, rated: bool, belief: Any, q: Array, drift: Array, rate: Array) -> dict[str, Array]:
    """Errors of attitude (rad, on the left in B) and drift (rad/s), their sigmas, and NEES of the 6 by the filter's own
    retraction."""
    truth: Any = AttitudeRateDrift(q, rate, drift) if rated else AttitudeDrift(q, drift)
    own = filter.retraction.boxminus(truth, belief.mean)
    P = belief.cov
    if rated:
        keep = np.array([0, 1, 2, 6, 7, 8])
        own, P = own[keep], P[keep][:, keep]
    attitude, P_B = attitude_part(filter), P[:3, :3]
    if attitude is so3_right:
        P_B = small.congruence(quaternion.to_matrix(belief.mean.q_BN), P_B)
    scale = 2.0 if attitude is vector_part_left else 1.0
    white = small.matvec(small.invert_lower(small.cholesky(P)), own)
    flip = jnp.sum(q * belief.mean.q_BN) < 0.0
    return {
        "error": so3_left.boxminus(q, belief.mean.q_BN),
        "sigma": scale * jnp.sqrt(jnp.diagonal(P_B)),
        "drift": drift - belief.mean.b,
        "drift_sigma": jnp.sqrt(jnp.diagonal(P)[3:]),
        "nees": jnp.sum(white**2),
        "flip": flip,
    }


@partial(jax.jit, static_argnames=("filter", "front", "branches", "main"))
def estimate(
    model: Model, prior: Prior, bridging: Bridging, shared: Shared, data: Data, *,
    filter: Any, front: str, branches: tuple, main: int,
) -> dict[str, Array]:  # fmt: skip
    """All passes of one estimator over all runs of `data`. front: what it measures, "stars", "quest" (attitude), or
    "rate" (stars, and the gyro as a sensor). branches: (kind, start, count) of each."""
    rated = front == "rate"

    def one(data: Data) -> dict[str, Array]:
        rate, extra, drifts = bridged(data, shared, bridging)
        q0_cov = data.q_cov[0]
        sign = jnp.where(jnp.sum(data.q_star[0] * shared.q[0]) < 0.0, -1.0, 1.0)  # q_0 is right, as (13) needs it
        start = make_belief(filter, rated, prior, sign * data.q_star[0], q0_cov, data.rate[0])
        turn = lambda a: quaternion.exp(a * data.axis)

        def begin(belief: Any, saved: Any, last: Array, x: Any) -> tuple[Any, Array]:
            """The belief with which a step begins, and the last continuous q_star."""
            mean = saved.mean.__class__(
                **{**vars(saved.mean), "q_BN": quaternion.multiply(turn(x.turn), saved.mean.q_BN)}
            )
            upset = saved.__class__(**{**vars(saved), "mean": mean})
            off = quaternion.multiply(turn(x.turn), shared.q[0])
            wrong = make_belief(filter, rated, prior, off, prior.wrong**2 * jnp.eye(3), data.rate[0])
            pick = lambda a, b, c: jnp.where(x.begin == CONTINUE, a, jnp.where(x.begin == FROM_WRONG, c, b))
            return (
                jax.tree.map(pick, belief, upset, wrong),
                jnp.where(x.begin == CONTINUE, last, shared.q[x.index]),
            )

        def body(carry: Any, x: Any) -> Any:
            belief, refused, saved, last = carry
            belief, last = begin(belief, saved, last, x)
            refused = jnp.where(x.begin == CONTINUE, refused, 0)
            u = GyroInput(x.rate, x.extra * jnp.eye(3), x.drifts)
            k = x.index + 1
            seen = shared.seen[k] & ~x.dark
            flip = jnp.asarray(False)
            if front == "quest":
                raw, there = data.q_star[k], jnp.sum(seen) > 1
                continuous = jnp.where(jnp.sum(raw * last) < 0.0, -raw, raw)  # (13), with sign(0) = +1
                last = jnp.where(there, continuous, last)
                z = jnp.where(prior.random_sign, raw, continuous)
                flip = there & (jnp.sum(z * shared.q[k]) < 0.0)
                R = jnp.where(prior.isotropic, prior.star_sigma**2 * jnp.eye(3), data.q_cov[k])
                ms = (Measurement(z, 0.25 * R, there[None]),)
            else:
                ms = (Measurement(data.z[k], shared.r_N[k], seen),)
            if rated:
                alive = prior.has_gyro & (x.policy == CODES["none"])
                ms = (Measurement(x.rate, prior.gyro_sigma**2 * jnp.eye(3), alive[None]), *ms)
            belief, refused, _, infos = step(filter, model, belief, refused, u, jnp.asarray(1.0), ms, prior.gate)
            saved = jax.tree.map(lambda a, b: jnp.where(x.save, a, b), belief, saved)
            true_drift = data.drift[x.index] + x.offset * data.axis
            s = score(filter, rated, belief, shared.q[k], true_drift, shared.turned[x.index])
            if front == "quest":
                s["flip"] = flip
            # Without a gyro nothing is known of its drift, and the filter of that kind here keeps no covariance.
            for key in ("sigma", "drift", "drift_sigma", "nees"):
                s[key] = jnp.where(prior.has_gyro, s[key], jnp.nan)
            info = infos[-1]
            s |= {"nis": info.nis, "dof": info.dof, "reset": info.status == RESET}
            return (belief, refused, saved, last), s

        xs = Step(
            shared.index, shared.policy, shared.dark, shared.begin, shared.turn, shared.offset, shared.save,
            rate, extra, drifts,
        )  # fmt: skip
        refused = jnp.zeros(len(model.sensors), dtype=int)
        _, out = jax.lax.scan(body, (start, refused, start, shared.q[0]), xs)
        return summed_up(out, branches, main, prior.recovered)

    return jax.vmap(one)(data)


def summed_up(s: dict[str, Array], branches: tuple, main: int, recovered: Array) -> dict[str, Array]:
    """What is recorded of a run: the main pass thinned, its last WINDOW_S in full as sums, and of each branch its figure."""
    thin = slice(EVERY - 1, main, EVERY)
    window = slice(max(main - WINDOW_S, 0), main)
    angle = jnp.sqrt(jnp.sum(s["error"] ** 2, axis=-1))
    out = {
        "error_rad": s["error"][thin],
        "sigma_rad": s["sigma"][thin],
        "drift_error_rad_s": s["drift"][thin],
        "drift_sigma_rad_s": s["drift_sigma"][thin],
        "nees": s["nees"][thin],
        "nis": s["nis"][thin],
        "nis_dof": s["dof"][thin],
        "attitude_mean_square_rad2": jnp.mean(s["error"][window] ** 2, axis=0),
        "drift_mean_square_rad2_s2": jnp.mean(s["drift"][window] ** 2, axis=0),
        "nees_mean": jnp.mean(s["nees"][window]),
        "sign_errors": jnp.sum(s["flip"][:main]),
        "resets": jnp.sum(s["reset"][:main]),
    }
    peaks, losses, recoveries, tracks = [], [], [], []
    for kind, start, count in branches:
        piece = angle[start : start + count]
        if kind == "policy":
            peaks.append(jnp.max(piece))
            tracks.append(piece)
        elif kind == "star_loss":
            losses.append(jnp.stack([piece[0], piece[STAR_LOSS_S - 1], piece[-1]]))
        else:
            # Steps up to the last one that is not below the limit; NaN if that is the very last.
            above = ~(piece < recovered)
            last = count - jnp.argmax(above[::-1])
            last = jnp.where(jnp.any(above), last, 0)
            recoveries.append(jnp.where(last < count, last.astype(piece.dtype), jnp.nan))
    nothing = jnp.zeros((0,))
    out["outage_peak_rad"] = jnp.stack(peaks) if peaks else nothing
    out["outage_angle_rad"] = jnp.stack(tracks) if tracks else jnp.zeros((0, 0))
    out["star_loss_rad"] = losses[0] if losses else jnp.full((3,), jnp.nan)
    out["recovery_s"] = jnp.stack(recoveries) if recoveries else nothing
    return out


@partial(jax.jit, static_argnames=("filter", "branches", "main"))
def smoothed(
    model: Model,
    prior: Prior,
    bridging: Bridging,
    shared: Shared,
    data: Data,
    *,
    filter: Any,
    branches: tuple,
    main: int,
) -> dict[str, Array]:
    """The main pass of `filter` with star directions, smoothed backward. It has no branches: their entries are NaN."""

    def one(data: Data) -> dict[str, Array]:
        rate, extra, drifts = (a[:main] for a in bridged(data, shared, bridging))
        sign = jnp.where(jnp.sum(data.q_star[0] * shared.q[0]) < 0.0, -1.0, 1.0)
        start = make_belief(filter, False, prior, sign * data.q_star[0], data.q_cov[0], data.rate[0])
        u = GyroInput(rate, extra[:, None, None] * jnp.eye(3), drifts)
        m = Measurement(data.z[1:], shared.r_N[1:], shared.seen[1:] & ~shared.dark[:main, None])

        def keep(belief: Any, predicted: Any, infos: Any) -> Any:
            return belief, predicted, infos[0].nis, infos[0].dof

        _, _, (beliefs, predicted, nis, dof) = run(filter, model, start, u, jnp.ones(main), (m,), prior.gate, keep=keep)
        beliefs = smooth(filter.retraction, beliefs, predicted)
        s = jax.vmap(partial(score, filter, False))(beliefs, shared.q[1:], data.drift, shared.turned)
        s |= {"nis": nis, "dof": dof, "reset": jnp.zeros(main, bool)}
        missing = {k: jnp.full((1, *v.shape[1:]), jnp.nan) for k, v in s.items() if v.dtype == jnp.float64}
        end = max((start + count for _, start, count in branches), default=main)
        padded = {
            k: jnp.concatenate([v, jnp.repeat(missing[k], end - main, axis=0)]) if k in missing else v
            for k, v in s.items()
        }
        return summed_up(padded, branches, main, prior.recovered)

    return jax.vmap(one)(data)
