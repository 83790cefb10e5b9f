"""Sensors: what sensors.toml says about them. Import the modules; this file loads nothing."""
