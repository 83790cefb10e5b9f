"""Optical navigation by frames of a target body: `helmstar opnav`."""
