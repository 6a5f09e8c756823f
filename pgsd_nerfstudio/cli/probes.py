"""What `pgsd doctor` tries in a process of its own each, so that a library that is broken or crashes takes nothing with it.

`python -m pgsd_nerfstudio.cli.probes NAME` tries one and prints what it found as JSON; if it cannot be used, the last line on
stderr says why and the exit code is not 0.
"""

# Taichi reads the annotations of its kernels, which must not be strings.
import importlib.util
import json
import os
import shutil
import sys
import sysconfig
from collections.abc import Callable
from pathlib import Path
from typing import Any


def torch() -> dict[str, Any]:
    """Versions, and the GPUs that torch can use: name and memory in bytes."""
    import torch

    devices = []
    if torch.cuda.is_available():
        for index in range(torch.cuda.device_count()):
            free, total = torch.cuda.mem_get_info(index)
            devices.append({"name": torch.cuda.get_device_name(index), "free": free, "total": total})
        torch.ones(2, device="cuda").sum().item()  # a kernel runs at all
    return {
        "version": torch.__version__,
        "cuda": torch.version.cuda,
        "threads": torch.get_num_threads(),
        "devices": devices,
    }


def gsplat() -> dict[str, Any]:
    """Whether gsplat's kernels are compiled, and the tools that compile them."""
    from importlib.metadata import version

    from torch.utils.cpp_extension import _get_build_directory

    compiled = importlib.util.find_spec("gsplat.csrc") is not None
    if not compiled:
        compiled = (Path(_get_build_directory("gsplat_cuda", False)) / "gsplat_cuda.so").is_file()
    headers = (Path(sysconfig.get_paths()["include"]) / "Python.h").is_file()
    tools = {"nvcc": shutil.which("nvcc"), "g++": shutil.which("g++"), "Python.h": headers}
    lacks = [name for name, found in tools.items() if not found]
    return {
        "version": version("gsplat"),
        "compiled": compiled,
        "lacks": lacks,
        "triton": bool(importlib.util.find_spec("triton")),
    }


def taichi() -> dict[str, Any]:
    """Version, after a kernel was compiled and run."""
    import taichi as ti

    ti.init(arch=ti.cpu, log_level=ti.ERROR, offline_cache=False)

    @ti.kernel
    def doubled(x: ti.i32) -> ti.i32:  # type: ignore[valid-type]
        return 2 * x  # type: ignore[operator]

    if doubled(21) != 42:
        raise SystemExit("a kernel computes a wrong result")
    return {"version": ".".join(map(str, ti.__version__))}


def open3d() -> dict[str, Any]:
    """Version, after a ray was cast at a triangle."""
    import numpy as np
    import open3d as o3d

    tensor = o3d.core.Tensor.from_numpy
    scene = o3d.t.geometry.RaycastingScene()
    corners = np.array([[-1, -1, 1], [1, -1, 1], [0, 1, 1]], np.float32)
    scene.add_triangles(tensor(corners), tensor(np.array([[0, 1, 2]], np.uint32)))
    hit = scene.cast_rays(tensor(np.array([[0, 0, 0, 0, 0, 1]], np.float32)))["t_hit"].numpy()
    if abs(float(hit[0]) - 1.0) > 1e-5:
        raise SystemExit("a ray misses a triangle that is before it")
    return {"version": o3d.__version__}


def numba() -> dict[str, Any]:
    """Version, the folder where compiled kernels of the rasterizer are kept, and how many are."""
    import numba
    from numba.core.caching import CompileResultCacheImpl

    room = Path(__file__).resolve().parent.parent / "rendering"
    # numba decides by the file of a function; one of the rasterizer's would have to be imported with torch.
    names: dict[str, Any] = {"__name__": "rasterizer"}
    exec(compile("def function(): pass", str(room / "projection.py"), "exec"), names)
    try:
        folder = CompileResultCacheImpl(names["function"]).locator.get_cache_path()
    except RuntimeError:
        return {"version": numba.__version__, "folder": None, "kernels": 0}
    kernels = len([*Path(folder).glob("*.nbi")]) if Path(folder).is_dir() else 0
    return {"version": numba.__version__, "folder": folder, "kernels": kernels}


PROBES: dict[str, Callable[[], dict[str, Any]]] = {
    "torch": torch,
    "gsplat": gsplat,
    "taichi": taichi,
    "open3d": open3d,
    "numba": numba,
}

if __name__ == "__main__":
    # Libraries greet on stdout: what was found goes to the real one, everything else to stderr.
    answer = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    found = PROBES[sys.argv[1]]()
    print(json.dumps(found), file=answer, flush=True)
    os._exit(0)  # not all of them end well, which is no matter here
