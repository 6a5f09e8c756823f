"""Weather for any 3D Gaussian scene, as a nerfstudio method."""

import os
import sys

__version__ = "0.1.0"

# OpenMP threads that wait by spinning slow each other down. Read when torch is loaded: in nerfstudio's own commands, which load
# it first, the shell has to say so.
if "torch" not in sys.modules:
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
