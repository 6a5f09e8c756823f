"""Read .splat: 32 bytes for each Gaussian and nothing else, as in antimatter15's viewer (https://github.com/antimatter15/splat).

Three floats for the centre, three for the scales, four bytes for colour and opacity, four for the quaternion (wxyz, 128 is 0).
There are no harmonics, and colours beyond black and white are clipped.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from pgsd_nerfstudio.scene.errors import SceneError
from pgsd_nerfstudio.scene.gaussians import Gaussians
from pgsd_nerfstudio.scene.splats.activation import harmonics
from pgsd_nerfstudio.scene.splats.bounds import contents

ROW = np.dtype([("centre", "<f4", 3), ("scales", "<f4", 3), ("colour", "u1", 4), ("rotation", "u1", 4)])


def read_dot_splat(path: Path) -> Gaussians:
    """Gaussians of a .splat, not yet checked.

    Raises:
        SceneError: the file cannot be opened, or holds no whole number of Gaussians.
    """
    data = contents(path)
    if len(data) % ROW.itemsize:
        raise SceneError(f"{path} is no .splat or cut off: {len(data):,} bytes are no multiple of {ROW.itemsize}")
    table = np.frombuffer(data, ROW)
    colour = table["colour"].astype(np.float32) / 255
    return Gaussians(
        torch.from_numpy(table["centre"].copy()),
        torch.from_numpy((table["rotation"].astype(np.float32) - 128) / 128),
        torch.from_numpy(table["scales"].copy()),
        torch.from_numpy(colour[:, 3].copy()),
        harmonics(torch.from_numpy(colour[:, :3])),
    )
