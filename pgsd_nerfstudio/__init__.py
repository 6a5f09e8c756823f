"""Weather for any 3D Gaussian scene, as a nerfstudio method."""

import os

__version__ = "0.1.0"

# OpenMP threads that wait by spinning slow each other down as soon as two programs share the cores; read when torch is loaded.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")
