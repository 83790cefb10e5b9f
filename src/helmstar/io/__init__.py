"""Measured data from files: tables, clocks, telemetry, screening. Import the modules; this file loads nothing."""
