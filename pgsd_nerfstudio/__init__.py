"""Weather for any 3D Gaussian scene, as a nerfstudio method."""

__version__ = "0.1.0"
