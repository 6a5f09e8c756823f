"""Figures: what `pgsd bench` measures and `pgsd verify` compares. No product code imports from here."""
