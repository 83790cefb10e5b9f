"""helmstar: spacecraft attitude and navigation from stars, gyros and cameras, with honest covariances.

Importing the package loads nothing heavy. Import the rooms you need:

- `helmstar.geometry` SO(3), quaternions, retractions
- `helmstar.attitude` Wahba's problem
- `helmstar.filters`  filters and smoother over any model of `helmstar.models`
- `helmstar.evaluate` consistency tests and Cramer-Rao bounds
- `helmstar.scenarios`, `helmstar.campaign`, `helmstar.report`  Monte Carlo experiments
- `helmstar.telemetry` the same filters on measured data
"""

__version__ = "0.1.0"
