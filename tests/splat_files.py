"""Random Gaussians, and files of them that are not written by the readers' means: value by value, as the formats describe."""

from __future__ import annotations

import gzip
import io
import json
import struct
import zipfile
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from plyfile import PlyData, PlyElement

from pgsd_nerfstudio.scene.gaussians import Gaussians

DATA = Path(__file__).parent / "data" / "splats"
C0 = 0.28209479177387814


def a_cloud(n: int = 24, degree: int = 3, seed: int = 0) -> Gaussians:
    """Gaussians in float64 whose centres are told apart after other files have put them into another order."""
    draw = np.random.default_rng(seed)
    grid = np.stack(np.meshgrid(*[np.arange(4.0)] * 3), axis=-1).reshape(-1, 3)[:n]
    quats = draw.normal(size=(n, 4))
    values = (
        grid + draw.uniform(-0.2, 0.2, (n, 3)) - 1.5,
        quats / np.linalg.norm(quats, axis=1, keepdims=True),
        np.exp(draw.uniform(-6, -1, (n, 3))),
        draw.uniform(0.05, 0.95, n),
        draw.uniform(-0.5, 0.5, (n, (degree + 1) ** 2, 3)) * np.array([3.0] + [1.0] * ((degree + 1) ** 2 - 1))[:, None],
    )
    return Gaussians(*map(torch.from_numpy, values))


def covariances(gaussians: Gaussians) -> torch.Tensor:
    """[n, 3, 3] in float64: what scales and quaternions mean together, whatever their order and signs."""
    w, x, y, z = (gaussians.quats.double() / gaussians.quats.double().norm(dim=1, keepdim=True)).unbind(1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    turned = torch.stack([torch.stack(row, dim=1) for row in rows], dim=1) * gaussians.scales.double()[:, None]
    return turned @ turned.transpose(1, 2)


def matched(read: Gaussians, original: Gaussians) -> tuple[Gaussians, Gaussians]:
    """Both in the order of the original, the second with as many coefficients as the first."""
    nearest = torch.cdist(original.means.double(), read.means.double()).argmin(dim=1)
    assert sorted(nearest.tolist()) == list(range(len(original)))
    kept = Gaussians(*(original.tensors[name] for name in ("means", "quats", "scales", "opacities")), original.colors)
    return read.select(nearest), Gaussians(
        kept.means, kept.quats, kept.scales, kept.opacities, kept.colors[:, : read.colors.shape[1]]
    )


def table_of(cloud: Gaussians, double: bool = False) -> dict[str, np.ndarray]:
    """Columns of a 3DGS .ply."""
    kind = np.float64 if double else np.float32
    columns = {name: cloud.means[:, i].numpy().astype(kind) for i, name in enumerate("xyz")}
    columns |= {f"f_dc_{i}": cloud.colors[:, 0, i].numpy() for i in range(3)}
    each = cloud.colors.shape[1] - 1
    columns |= {f"f_rest_{c * each + k}": cloud.colors[:, k + 1, c].numpy() for c in range(3) for k in range(each)}
    columns["opacity"] = cloud.opacities.logit().numpy()
    columns |= {f"scale_{i}": cloud.scales[:, i].log().numpy() for i in range(3)}
    columns |= {f"rot_{i}": cloud.quats[:, i].numpy() for i in range(4)}
    return columns


def write_ply(path: Path, columns: dict[str, np.ndarray], *, text: bool = False, order: str = "<", comments=()) -> Path:
    """With plyfile; columns of float64 that are no centres become float32."""
    kinds = {n: v.dtype if n in "xyz" or v.dtype.kind == "u" else np.dtype("f4") for n, v in columns.items()}
    table = np.empty(len(next(iter(columns.values()))), [(name, kinds[name]) for name in columns])
    for name, values in columns.items():
        table[name] = values
    elements = [PlyElement.describe(table, "vertex")]
    PlyData(elements, text=text, byte_order=order, comments=list(comments)).write(str(path))
    return path


def write_spz(path: Path, cloud: Gaussians, version: int, *, flags: int = 0, extension: bytes = b"") -> Path:
    """Versions 1 to 3."""
    n, coefficients = cloud.colors.shape[:2]
    parts = []
    for centre in cloud.means.tolist():
        for value in centre:
            parts.append(struct.pack("<e", value) if version == 1 else round(value * 4096).to_bytes(3, "little", signed=True))
    parts.append(bytes(round(o * 255) for o in cloud.opacities.tolist()))
    parts.append(bytes(round((c * 0.15 + 0.5) * 255) for row in cloud.colors[:, 0].tolist() for c in row))
    parts.append(bytes(round((np.log(s) + 10) * 16) for row in cloud.scales.tolist() for s in row))
    for w, x, y, z in cloud.quats.tolist():
        if version < 3:
            sign = -1 if w < 0 else 1
            parts.append(bytes(round(sign * value * 127.5 + 127.5) for value in (x, y, z)))
            continue
        quaternion = [x, y, z, w]
        largest = max(range(4), key=lambda i: abs(quaternion[i]))
        word = largest
        for i, value in enumerate(quaternion):
            if i != largest:
                negative = (value < 0) != (quaternion[largest] < 0)
                word = word << 10 | negative << 9 | int(511 * abs(value) * 2**0.5 + 0.5)
        parts.append(struct.pack("<I", word))
    parts.append(bytes(min(255, round(v * 128) + 128) for g in cloud.colors[:, 1:].tolist() for row in g for v in row))
    degree = round(coefficients**0.5) - 1
    header = struct.pack("<4sIIBBBB", b"NGSP", version, n, degree, 12, flags | 2 * bool(extension), 0)
    path.write_bytes(gzip.compress(header + b"".join(parts) + extension))
    return path


def write_splat(path: Path, cloud: Gaussians) -> Path:
    rows = []
    for i in range(len(cloud)):
        rows.append(struct.pack("<6f", *cloud.means[i].tolist(), *cloud.scales[i].tolist()))
        colour = (cloud.colors[i, 0] * C0 + 0.5).clamp(0, 1).tolist()
        rows.append(bytes(round(255 * value) for value in (*colour, cloud.opacities[i].item())))
        rows.append(bytes(min(255, round(128 * value) + 128) for value in cloud.quats[i].tolist()))
    path.write_bytes(b"".join(rows))
    return path


def write_ksplat(path: Path, cloud: Gaussians, *, full: int, partial: list[int], size: int = 4) -> Path:
    """Level 1: `full` buckets of `size` Gaussians, then smaller ones; each bucket's middle is that of its Gaussians."""
    counts = [size] * full + partial
    n, block, steps = len(cloud), 8.0, 32767
    assert sum(counts) == n
    ends = np.cumsum([0, *counts])
    degree = round(cloud.colors.shape[1] ** 0.5) - 1
    middles = [cloud.means[a:b].mean(dim=0).tolist() for a, b in pairwise(ends)]
    rows = []
    for i in range(n):
        middle = middles[int(np.searchsorted(ends, i, side="right")) - 1]
        rows.append(
            struct.pack(
                "<3H",
                *(round((c - m) / (block / 2) * steps) + steps for c, m in zip(cloud.means[i].tolist(), middle, strict=True)),
            )
        )
        rows.append(struct.pack("<7e", *cloud.scales[i].tolist(), *cloud.quats[i].tolist()))
        colour = (cloud.colors[i, 0] * C0 + 0.5).clamp(0, 1).tolist()
        rows.append(bytes(round(255 * value) for value in (*colour, cloud.opacities[i].item())))
        for band in range(1, degree + 1):
            rows.append(b"".join(struct.pack("<e", v) for v in cloud.colors[i, band**2 : (band + 1) ** 2].T.flatten().tolist()))
    header = struct.pack("<4B4IHH5f", 0, 1, 0, 0, 1, 1, n, n, 1, 0, 0, 0, 0, -1.5, 1.5).ljust(4096, b"\0")
    section = struct.pack("<4IfHHIIIIH", n, n, size, len(counts), block, 12, 0, steps, 0, full, len(partial), degree)
    buckets = struct.pack(f"<{len(partial)}I", *partial) + b"".join(struct.pack("<3f", *middle) for middle in middles)
    path.write_bytes(header + section.ljust(1024, b"\0") + buckets + b"".join(rows))
    return path


def webp(pixels: np.ndarray, **how) -> bytes:
    stream = io.BytesIO()
    Image.fromarray(pixels.astype(np.uint8), "RGBA").save(stream, "WEBP", **{"lossless": True, "exact": True, **how})
    return stream.getvalue()


def write_first_sog(path: Path, cloud: Gaussians) -> Path:
    """Version 1, which has least and largest values in place of codebooks, and a palette with an entry for each Gaussian."""
    n, side = len(cloud), 5
    files, meta = {}, {}

    def spread(values: np.ndarray, steps: int) -> tuple[np.ndarray, list[float], list[float]]:
        low, high = values.min(axis=0), values.max(axis=0)
        return np.round((values - low) / (high - low) * steps).astype(np.int64), low.tolist(), high.tolist()

    def picture(name: str, rows: np.ndarray) -> str:
        full = np.full((side * side, 4), 255, np.int64)
        full[:n, : rows.shape[1]] = rows
        files[f"{name}.webp"] = webp(full.reshape(side, side, 4))
        return f"{name}.webp"

    logs = np.sign(cloud.means.numpy()) * np.log1p(np.abs(cloud.means.numpy()))
    steps, low, high = spread(logs, 65535)
    names = [picture("means_l", steps & 255), picture("means_u", steps >> 8)]
    meta["means"] = {"shape": [n, 3], "mins": low, "maxs": high, "files": names}
    steps, low, high = spread(cloud.scales.log().numpy(), 255)
    meta["scales"] = {"mins": low, "maxs": high, "files": [picture("scales", steps)]}
    rows = []
    for quaternion in cloud.quats.tolist():
        largest = max(range(4), key=lambda i: abs(quaternion[i]))
        sign = -1 if quaternion[largest] < 0 else 1
        small = [round((sign * value * 2**0.5 * 0.5 + 0.5) * 255) for i, value in enumerate(quaternion) if i != largest]
        rows.append([*small, 252 + largest])
    meta["quats"] = {"files": [picture("quats", np.array(rows))]}
    raw = np.concatenate([cloud.colors[:, 0].numpy(), cloud.opacities.logit().numpy()[:, None]], axis=1)
    steps, low, high = spread(raw, 255)
    meta["sh0"] = {"mins": low, "maxs": high, "files": [picture("sh0", steps)]}
    each = cloud.colors.shape[1] - 1
    palette = np.zeros((1, 64 * each, 4), np.int64)
    palette[..., 3] = 255
    palette[0, : n * each, :3] = np.round((cloud.colors[:, 1:].numpy().reshape(n * each, 3) + 0.5) * 255)
    files["palette.webp"] = webp(palette)
    labels = np.stack([np.arange(n), np.zeros(n, np.int64)], axis=1)
    meta["shN"] = {"mins": -0.5, "maxs": 0.5, "files": ["palette.webp", picture("labels", labels)]}
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in {"meta.json": json.dumps(meta).encode(), **files}.items():
            archive.writestr(f"scene/{name}", data)
    return path


def write_gltf(
    path: Path, cloud: Gaussians, *, node: dict | None = None, logarithms: bool = False, packed: bytes = b""
) -> Path:
    """A .gltf with its bytes in a .bin beside it, or a .glb; with `packed` those of a .spz in place of attributes."""
    prefix = "KHR_gaussian_splatting:"
    columns = {
        "POSITION": cloud.means,
        f"{prefix}ROTATION": cloud.quats[:, [1, 2, 3, 0]],
        f"{prefix}SCALE": cloud.scales.log() if logarithms else cloud.scales,
        f"{prefix}OPACITY": cloud.opacities[:, None],
    }
    k = 0
    for degree in range(round(cloud.colors.shape[1] ** 0.5)):
        for i in range(2 * degree + 1):
            columns[f"{prefix}SH_DEGREE_{degree}_COEF_{i}"] = cloud.colors[:, k]
            k += 1
    blob, views, accessors, attributes = b"", [], [], {}
    for name, values in () if packed else columns.items():
        data = values.numpy().astype("<f4").tobytes()
        views.append({"buffer": 0, "byteOffset": len(blob), "byteLength": len(data)})
        kind = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[values.shape[1]]
        attributes[name] = len(accessors)
        accessors.append({"bufferView": len(accessors), "componentType": 5126, "count": len(cloud), "type": kind})
        blob += data
    described: dict = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    if packed:
        blob, views = packed, [{"buffer": 0, "byteLength": len(packed)}]
        described["extensions"] = {"KHR_gaussian_splatting_compression_spz_2": {"bufferView": 0}}
    primitive = {"mode": 0, "attributes": attributes, "extensions": {"KHR_gaussian_splatting": described}}
    meta = {
        "asset": {"version": "2.0"},
        "extensionsUsed": ["KHR_gaussian_splatting"],
        "scenes": [{"nodes": [0]}],
        "nodes": [{"children": [1], **(node or {})}, {"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "buffers": [{"byteLength": len(blob)}],
        "bufferViews": views,
        "accessors": accessors,
    }
    if path.suffix == ".gltf":
        meta["buffers"][0]["uri"] = f"{path.stem}.bin"
        path.with_suffix(".bin").write_bytes(blob)
        path.write_text(json.dumps(meta))
        return path
    text = json.dumps(meta).encode()
    text += b" " * (-len(text) % 4)
    blob += b"\0" * (-len(blob) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(blob), b"BIN\0") + blob
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)
    return path
