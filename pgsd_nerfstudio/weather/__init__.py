"""The weather of a scene: one way to make it, render it, and keep it; the Python API and all commands are its callers."""
