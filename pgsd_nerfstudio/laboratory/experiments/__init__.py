"""Experiments with a known end, which judge the material point method."""
