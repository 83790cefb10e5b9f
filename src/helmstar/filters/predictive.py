"""The predictive filter (Crassidis and Markley 1997): of all model errors the smallest that explains the measurement.

The model error d is what `Process.step` takes as its noise w. At each measurement y with covariance R, with x' = f(x, 0) and
G = d x' / d w,

    d = [(H G)^T R^-1 (H G) + W]^-1 (H G)^T R^-1 (y - h(x')),        x = x' [+] G d                     (17), (20)

which minimises e^T R^-1 e + d^T W d over the next measurement. It keeps no covariance: it is the EKF whose covariance before
every update is G W^-1 G^T, whatever it knew. So its error is not judged by NEES, and W is its one tuning.
Source: Crassidis and Markley, "Predictive filtering for attitude estimation without rate sensors", JGCD 20(3), 1997.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from ..backend import jax, jnp
from ..core import Gate, Gaussian, Info, Measurement, Predicted, Process, Sensor, pytree
from ..geometry import small
from ..geometry.retraction import Retraction
from .ekf import ErrorStateKalmanFilter

Array = jax.Array


@pytree
class PredictiveBelief(Gaussian):
    """The estimate; `cov` is G W^-1 G^T of the last prediction, no error covariance. weight (noise dim,): diagonal of W."""

    weight: Array


@dataclass(frozen=True)
class PredictiveFilter:
    """Over any retraction and process; `PredictiveBelief` carries W."""

    retraction: Retraction

    def predict(self, belief: PredictiveBelief, process: Process, u: Any, dt: Array) -> tuple[Any, Predicted]:
        """x' = f(x, 0), with G W^-1 G^T in the place of a covariance."""
        r, x = self.retraction, belief.mean
        w0 = jnp.zeros(process.noise.dim, belief.cov.dtype)
        mean = process.step(process.params, x, u, dt, w0)
        if process.jacobian is not None:
            _, G = process.jacobian(process.params, x, u, dt)
            G = jnp.eye(r.dim, dtype=belief.cov.dtype) if G is None else G
        else:
            G = jax.jacfwd(lambda w: r.boxminus(process.step(process.params, x, u, dt, w), mean))(w0)
        cov = small.matmul(G / belief.weight, small.transpose(G))
        return PredictiveBelief(mean, cov, belief.weight), Predicted(mean, cov, jnp.eye(r.dim, dtype=cov.dtype))

    def update(
        self, belief: PredictiveBelief, sensor: Sensor, m: Measurement, gate: Gate, refused: Array
    ) -> tuple[Any, Info]:
        """x = x' [+] G d, computed in the gain form G W^-1 G^T H^T (H G W^-1 G^T H^T + R)^-1."""
        inner = ErrorStateKalmanFilter(self.retraction, carry="none")
        b, info = inner.update(Gaussian(belief.mean, belief.cov), sensor, m, gate, refused)
        return PredictiveBelief(b.mean, belief.cov, belief.weight), info
