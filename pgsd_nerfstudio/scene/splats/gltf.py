"""Read glTF (.glb, .gltf) with the extension KHR_gaussian_splatting, also where its Gaussians are packed as .spz within it.

Formats: https://github.com/KhronosGroup/glTF/tree/main/extensions/2.0/Khronos/KHR_gaussian_splatting (release candidate, 2026)
and its draft KHR_gaussian_splatting_compression_spz_2, which has packed Gaussians unpacked to left, up, front. The Gaussians of
all primitives are brought into the frame of the scene by the transforms of their nodes.
"""

from __future__ import annotations

import base64
import binascii
import json
import struct
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import unquote

import numpy as np
import torch
from torch import Tensor

from pgsd_nerfstudio.scene import rotations
from pgsd_nerfstudio.scene.errors import SceneError
from pgsd_nerfstudio.scene.gaussians import Gaussians
from pgsd_nerfstudio.scene.similarity import moved
from pgsd_nerfstudio.scene.splats.activation import joined
from pgsd_nerfstudio.scene.splats.bounds import contents
from pgsd_nerfstudio.scene.splats.spz import unpacked

SPLATS = "KHR_gaussian_splatting"
PACKED = (
    "KHR_gaussian_splatting_compression_spz_2",
    "KHR_gaussian_splatting_compression_spz",
    "KHR_spz_gaussian_splats_compression",
)
OTHER_PACKINGS = ("EXT_meshopt_compression", "KHR_meshopt_compression", "KHR_draco_mesh_compression")
ATTRIBUTES = ("POSITION", "ROTATION", "SCALE", "OPACITY", "SH_DEGREE_0_COEF_0")
TYPES = {5120: "i1", 5121: "u1", 5122: "i2", 5123: "u2", 5125: "u4", 5126: "f4"}
SIZES = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
DEEPEST = 64  # nodes within nodes
LONGEST_JSON = 1 << 26  # bytes


class _Fault(ValueError):
    """What is wrong with the file, without its name."""


def read_glb(path: Path) -> Gaussians:
    """Gaussians of a .glb, not yet checked.

    Raises:
        SceneError: the file is damaged, holds no Gaussians, or holds them packed or coloured in ways that are not read.
    """
    data = contents(path)
    chunks, at = {}, 12
    while at + 8 <= len(data):
        length, kind = struct.unpack_from("<I4s", data, at)
        if length > len(data) - at - 8:
            raise SceneError(f"{path} is cut off: copy or download it again")
        chunks.setdefault(kind, data[at + 8 : at + 8 + length])
        at += 8 + length
    if b"JSON" not in chunks:
        raise SceneError(f"{path} is damaged or of glTF 1: its first part is no JSON")
    return _read(path, chunks[b"JSON"], chunks.get(b"BIN\0"))


def read_gltf(path: Path) -> Gaussians:
    """Gaussians of a .gltf and of the files that it names in its folder, not yet checked.

    Raises:
        SceneError: as for `read_glb`.
    """
    return _read(path, contents(path), None)


def _read(path: Path, text: bytes, binary: bytes | None) -> Gaussians:
    try:
        if len(text) > LONGEST_JSON:
            raise _Fault(f"its JSON has {len(text):,} bytes")
        file = _File(path, json.loads(text), binary)
        parts = [
            moved(_primitive(file, primitive), transform) for transform, primitive in file.primitives() if _splats(primitive)
        ]
        if not parts:
            raise _Fault(f"no primitive of it has {SPLATS}: it is a mesh; train a splat on its photographs")
        return joined(parts)
    except RecursionError as error:
        raise SceneError(f"{path} cannot be read as glTF (its JSON is nested too deeply): download it again") from error
    except (ValueError, TypeError, KeyError, IndexError, AttributeError, OverflowError, struct.error) as error:
        if isinstance(error, SceneError):
            raise
        # JSON may hold anything in place of what the format asks for; the error's words say what.
        what = error if isinstance(error, ValueError) else f"{type(error).__name__}: {error}"
        raise SceneError(f"{path} cannot be read as glTF ({str(what)[:200]}): write or download it again") from error


def _splats(primitive: dict) -> bool:
    extensions = primitive.get("extensions", {})
    return SPLATS in extensions or any(name in extensions for name in PACKED)


class _File:
    """The JSON of the file with the bytes that it refers to."""

    def __init__(self, path: Path, meta: Any, binary: bytes | None) -> None:
        if not isinstance(meta, dict) or not isinstance(meta.get("asset"), dict):
            raise _Fault("its JSON describes no asset")
        self.path, self.meta, self.binary = path, meta, binary
        self.buffers: dict[int, bytes] = {}

    def item(self, kind: str, index: Any) -> dict:
        items = self.meta.get(kind, [])
        if isinstance(index, bool) or not isinstance(index, int) or not 0 <= index < len(items):
            raise _Fault(f"{kind} has no entry {str(index)[:20]}")
        return items[index]

    def primitives(self) -> Iterator[tuple[Tensor, dict]]:
        """All primitives of the scene that is shown, each with the transform of its node."""
        scene = (
            self.item("scenes", self.meta.get("scene", 0))
            if self.meta.get("scenes")
            else {"nodes": range(len(self.meta["nodes"]))}
        )
        waiting = [(index, torch.eye(4, dtype=torch.float64), 0) for index in scene.get("nodes", [])]
        seen = 0
        while waiting:
            index, above, depth = waiting.pop(0)
            seen += 1
            if depth > DEEPEST or seen > 100_000:
                raise _Fault("its nodes are nested in themselves")
            node = self.item("nodes", index)
            transform = above @ _transform(node)
            if "mesh" in node:
                for primitive in self.item("meshes", node["mesh"])["primitives"]:
                    yield transform, primitive
            waiting += [(child, transform, depth + 1) for child in node.get("children", [])]

    def view(self, index: Any) -> tuple[bytes, dict]:
        """Bytes of a buffer view, and its entry."""
        view = self.item("bufferViews", index)
        _refuse_packed(view.get("extensions", {}))
        buffer = self._buffer(view.get("buffer"))
        start, length = int(view.get("byteOffset", 0)), int(view["byteLength"])
        if start < 0 or length < 0 or start + length > len(buffer):
            raise _Fault(f"buffer view {index} reaches to byte {start + length:,} of {len(buffer):,}")
        return buffer[start : start + length], view

    def accessor(self, index: Any, size: int) -> Tensor:
        """[count, size] values, float32."""
        entry = self.item("accessors", index)
        kind, count = np.dtype("<" + TYPES[entry["componentType"]]), int(entry["count"])
        if "sparse" in entry or "bufferView" not in entry:
            raise _Fault(f"accessor {index} is sparse or has no bytes of its own")
        if SIZES.get(entry["type"]) != size:
            raise _Fault(f"accessor {index} is of the type {str(entry['type'])[:20]}")
        data, view = self.view(entry["bufferView"])
        start, stride = int(entry.get("byteOffset", 0)), int(view.get("byteStride") or kind.itemsize * size)
        if (
            count < 0
            or start < 0
            or stride < kind.itemsize * size
            or (count and start + stride * (count - 1) + kind.itemsize * size > len(data))
        ):
            raise _Fault(f"accessor {index} asks for {count:,} rows of a view of {len(data):,} bytes")
        rows = np.ndarray((count, size), kind, data, start, (stride, kind.itemsize)) if count else np.empty((0, size), kind)
        values = rows.astype(np.float32)
        if entry.get("normalized") and kind.kind in "iu":
            values = np.maximum(values / np.iinfo(kind).max, -1.0).astype(np.float32)
        return torch.from_numpy(values)

    def _buffer(self, index: Any) -> bytes:
        if index not in self.buffers:
            self.buffers[index] = self._bytes(self.item("buffers", index), index)
        return self.buffers[index]

    def _bytes(self, entry: dict, index: int) -> bytes:
        uri = entry.get("uri")
        if uri is None:
            if index or self.binary is None:
                raise _Fault(f"buffer {index} is missing")
            return self.binary
        if uri.startswith("data:"):
            try:
                return base64.b64decode(uri.partition(",")[2], validate=True)
            except binascii.Error as error:
                raise _Fault(f"buffer {index} is no base64") from error
        name = PurePosixPath(unquote(uri))
        if name.is_absolute() or ".." in name.parts or ":" in uri or "\\" in uri:
            raise _Fault(f"buffer {index} lies elsewhere ({uri[:80]})")
        try:
            return (self.path.parent / name).read_bytes()
        except OSError as error:
            raise _Fault(f"its file {name} cannot be opened ({error.strerror})") from error


def _refuse_packed(extensions: dict) -> None:
    if packing := next((name for name in OTHER_PACKINGS if name in extensions), None):
        raise _Fault(f"it is packed with {packing}, which is not read; gltf-transform unpacks it")


def _transform(node: dict) -> Tensor:
    """[4, 4] of a node: a matrix by columns, or translation, rotation (xyzw) and scale."""
    if "matrix" in node:
        return _numbers(node, "matrix", [0.0] * 16).reshape(4, 4).T
    transform = torch.eye(4, dtype=torch.float64)
    quaternion = torch.nn.functional.normalize(_numbers(node, "rotation", [0.0, 0.0, 0.0, 1.0]), dim=0)
    transform[:3, :3] = rotations.unitquat_to_rotmat(quaternion) * _numbers(node, "scale", [1.0] * 3)
    transform[:3, 3] = _numbers(node, "translation", [0.0] * 3)
    return transform


def _numbers(node: dict, name: str, usual: list[float]) -> Tensor:
    """Numbers of a node, as many as `usual` has, which stands for them where the node says nothing."""
    values = node.get(name, usual)
    if (
        not isinstance(values, list)
        or len(values) != len(usual)
        or not all(isinstance(value, (int, float)) for value in values)
    ):
        raise _Fault(f"{name} of a node is {str(values)[:40]}, not {len(usual)} numbers")
    return torch.tensor([float(value) for value in values], dtype=torch.float64)


def _primitive(file: _File, primitive: dict) -> Gaussians:
    extensions = {**primitive.get("extensions", {}), **primitive.get("extensions", {}).get(SPLATS, {}).get("extensions", {})}
    described = extensions.get(SPLATS, {})
    if (kernel := described.get("kernel", "ellipse")) != "ellipse":
        raise _Fault(f"its kernel is {str(kernel)[:40]}; ellipse is read")
    if (space := described.get("colorSpace", "srgb_rec709_display")) != "srgb_rec709_display":
        raise _Fault(f"its colours are {str(space)[:40]}; srgb_rec709_display is read")
    if packing := next((name for name in PACKED if name in extensions), None):
        return unpacked(file.path, file.view(extensions[packing]["bufferView"])[0], axes="LUF")
    _refuse_packed(extensions)
    held = {name.removeprefix(f"{SPLATS}:"): index for name, index in primitive["attributes"].items()}
    if missing := [name for name in ATTRIBUTES if name not in held]:
        raise _Fault(f"its Gaussians lack {', '.join(missing)}; write them with a newer version of the converter")
    scales = file.accessor(held["SCALE"], 3)
    if len(scales) and scales.min() < 0:
        scales = scales.exp()  # drafts until 2025 stored logarithms; what is linear is never negative
    coefficients, degree = [], 0
    while f"SH_DEGREE_{degree}_COEF_0" in held:
        coefficients += [file.accessor(held[f"SH_DEGREE_{degree}_COEF_{i}"], 3) for i in range(2 * degree + 1)]
        degree += 1
    means, quats, opacities = (file.accessor(held[n], size) for n, size in {"POSITION": 3, "ROTATION": 4, "OPACITY": 1}.items())
    counts = {len(values) for values in (means, quats, scales, opacities, *coefficients)}
    if len(counts) > 1:
        raise _Fault(f"its attributes have {' and '.join(map(str, sorted(counts)))} rows")
    return Gaussians(means, quats[:, [3, 0, 1, 2]], scales, opacities[:, 0], torch.stack(coefficients, dim=1))
