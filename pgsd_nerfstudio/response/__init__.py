"""The answer of the frozen scene: how it looks under the weather, as a function of its Gaussians and of time."""
